"""Train and measure one capture by the tree that this is run in (TREE/benchmarks): pair.py CAPTURE OUT STEPS. Prints times."""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path.cwd()))
from harness.job import _measured, configure
from harness.plan import Job, parser_of

capture, out, steps = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
words = ("--pipeline.model.evaluate-prune", "False", *sys.argv[4:])
job = Job("pair", "whole", capture.name, "sundae", str(capture), "sundae", steps, 42, options=words, parser=parser_of(capture))
config, command = configure(job, out)
_, measured = _measured(job, config, command)
kept = ("primitives", "train_s", "ms_frame", "ms_splat", "ms_head", "psnr", "ssim")
row = measured.as_json()
flat = {**row, **(row["configurations"][0].get("mean", {})), **row["configurations"][0]}
print("PAIR", json.dumps({k: flat.get(k) for k in kept}), json.dumps(row)[:1500], flush=True)
