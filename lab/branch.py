"""Trainings from one warm-up: branch.py CAPTURE OUT warm [--seed K], or CAPTURE OUT NAME [--seed K] KEEP WORD ... of ns-train."""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from harness.job import _measured, configure, perform  # noqa: E402
from harness.plan import Job, parser_of  # noqa: E402

capture, out, name, *words = sys.argv[1:]
data, out, seed = Path(capture), Path(out), 42
if words and words[0] == "--seed":
    seed, words = int(words[1]), words[2:]
parser = tuple(parser_of(data))
key = f"{data.name}-warm-s{seed}"
warm = ("--pipeline.model.pruning.mode", "off", "--pipeline.model.head.mode", "off", "--pipeline.model.stop-split-at", "12000",
        "--optimizers.means.scheduler.max-steps", "30000", "--schedule-length", "30000")  # fmt: skip
if name == "warm":
    perform(Job(key, "warm-up", data.name, "sundae-warm-up", str(data), "sundae", 12000, seed, options=warm, parser=parser), out)
    sys.exit()
keep, *words = words
steps = "18000"
if words and words[0] == "--steps":
    steps, words = words[1], words[2:]
options = ("--pipeline.model.pruning.keep-ratio", keep, "--pipeline.model.pruning.seed", str(seed), "--optimizers.means.scheduler.max-steps", steps,
           "--optimizers.compensation.scheduler.max-steps", steps, "--pipeline.model.evaluate-prune", "False", *words)  # fmt: skip
job = Job(f"{data.name}-{name}-s{seed}", "branch", data.name, name, str(data), "sundae", int(steps), seed, needs=key, options=options, parser=parser)
config, command = configure(job, out)
_, measured = _measured(job, config, command)
folder = out / "branches"
folder.mkdir(exist_ok=True)
(folder / f"{job.key}.json").write_text(json.dumps({"set": data.name, "arm": name, "seed": seed, "measured": measured.as_json()}) + "\n")
