"""Train one capture whole by options of ns-train, and append its figures: few_arms.py CAPTURE OUT NAME METHOD STEPS WORD ..."""

import json
import sys
from pathlib import Path

import torch
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from harness.job import _measured, configure  # noqa: E402
from harness.plan import Job, parser_of  # noqa: E402
from sundae_ns.report.measure import Subject  # noqa: E402

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
folder = Path(out) / f"{job.key}-{seed}"
config, command = configure(job, folder)
opened, measured = _measured(job, config, command)
subject = Subject.of_run(opened)
for i, truth in enumerate(subject.truths[:4]):
    image = subject.image(i)
    sheet = torch.cat([truth, image, (3 * (image - truth)).abs().clamp(0, 1)], 1).mul(255).byte().cpu().numpy()
    picture = Image.fromarray(sheet)
    picture.resize((1500, round(1500 * picture.height / picture.width))).save(folder.parent / f"{job.key}-{seed}-{i}.jpg", quality=88)
(folder / "result.json").write_text(json.dumps({"set": data.name, "arm": name, "seed": seed, "measured": measured.as_json()}) + "\n")
