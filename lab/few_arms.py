"""Train one capture whole by options of ns-train, and append its figures: few_arms.py CAPTURE OUT NAME METHOD STEPS WORD ..."""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from harness.job import _measured, configure  # noqa: E402
from harness.plan import Job, parser_of  # noqa: E402

capture, out, name, method, steps, *words = sys.argv[1:]
data = Path(capture)
parser = list(parser_of(data))
if any(path.name.startswith("eval_") for path in (data / "images").iterdir()):
    at = parser.index("interval")
    parser = [*parser[:at], "filename", *parser[at + 3 :]]
seed = 42
if words and words[0] == "--seed":
    seed, words = int(words[1]), words[2:]
words = ["--pipeline.model.evaluate-prune", "False", *words]
job = Job(f"{data.name}-{name}", "whole", data.name, name, str(data), method, int(steps), seed, options=tuple(words), parser=tuple(parser))
folder = Path(out) / job.key
config, command = configure(job, folder)
_, measured = _measured(job, config, command)
(folder / "result.json").write_text(json.dumps({"set": data.name, "arm": name, "seed": seed, "measured": measured.as_json()}) + "\n")
