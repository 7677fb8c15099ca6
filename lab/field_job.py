"""A whole field, grown and not pruned, as one .sog: field_job.py CAPTURE OUT STEPS."""

import sys
from pathlib import Path

import torch
from few_job import few_job  # its import finds the harness

from harness.job import _measured, configure
import sundae_ns as sn

capture, out, steps = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
words = ["--pipeline.model.pruning.mode", "off", "--pipeline.model.head.mode", "off", "--optimizers.means.scheduler.max-steps", steps,
         "--schedule-length", steps, "--pipeline.model.stop-split-at", str(min(int(steps) * 4 // 5, 12000))]  # fmt: skip
job = few_job(str(capture), f"field-{capture.name}", "field", "sundae", int(steps), words)
config, command = configure(job, out)
opened, measured = _measured(job, config, command)
print(measured.full.mean("psnr"))
sn.save(sn.load(opened.source).to(torch.device("cpu")), out / f"{capture.name}.sog")
