"""Train one capture whole by options of ns-train, and append its figures: few_arms.py CAPTURE OUT NAME METHOD STEPS WORD ..."""

import json
import os
import sys
from pathlib import Path

import torch
from PIL import Image

from few_job import few_job  # its import finds the harness

from harness.job import _measured, configure
from sundae_ns.report.measure import Subject

if more := int(os.environ.get("TWICE", 0)):  # views that were held out come so many times more, once they are back
    from sundae_ns.plugin.datamanager import SundaeDatamanager

    hold_out = SundaeDatamanager.hold_out

    def hold_out_then_repeat(self, indices):
        before = getattr(self, "held_out_indices", [])
        hold_out(self, indices)
        self.repeated = [*getattr(self, "repeated", []), *(more * [i for i in before if i not in self.held_out_indices])]
        self._served += [i for i in self.repeated if i not in self.held_out_indices]

    SundaeDatamanager.hold_out = hold_out_then_repeat

capture, out, name, method, steps, *words = sys.argv[1:]
job = few_job(capture, f"{Path(capture).name}-{name}", name, method, int(steps), words)
folder = Path(out) / job.key
config, command = configure(job, folder)
opened, measured = _measured(job, config, command)
subject = Subject.of_run(opened)
for i, truth in enumerate(subject.truths[:4]):
    image = subject.image(i)
    sheet = torch.cat([truth, image, (3 * (image - truth)).abs().clamp(0, 1)], 1).mul(255).byte().cpu().numpy()
    picture = Image.fromarray(sheet)
    picture.resize((1500, round(1500 * picture.height / picture.width))).save(folder.parent / f"{job.key}-{i}.jpg", quality=88)
(folder / "result.json").write_text(json.dumps({"set": job.scene, "arm": name, "seed": job.seed, "measured": measured.as_json()}) + "\n")
