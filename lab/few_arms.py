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

if until := os.environ.get("DROP_UNTIL"):  # leaves out Gaussians only until this step
    from dataclasses import replace

    from sundae_ns.plugin.model import SundaeModel
    from sundae_ns.train import graphed_step

    settings_of, kind_of = SundaeModel.render_settings, graphed_step._kind

    def settings_until(self, *, training):
        settings = settings_of(self, training=training)
        return settings if self.state.step < int(until) else replace(settings, drop_rate=0.0)

    SundaeModel.render_settings = settings_until
    graphed_step._kind = lambda state, inputs, settings: (kind_of(state, inputs, settings), settings.drop_rate)

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
