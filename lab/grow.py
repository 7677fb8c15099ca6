"""Train with growth where K training views show an error: grow.py CAPTURE OUT NAME METHOD STEPS WORD ... (GROW=share of the mean error).

A candidate of the densification grows if the error of the pixels that it colours, weighted by its blending weights and
averaged over ten random training views, is above GROW times the mean error of these views.
"""

import os
import random
import runpy
import sys
from pathlib import Path

import torch

from sundae_ns.scene.render import blending_weights, pass_inputs, render_view
from sundae_ns.train.densification import CappedStrategy, Densification

SHARE, VIEWS = float(os.environ.get("GROW", 0)), int(os.environ.get("GROW_VIEWS", 10))


@torch.no_grad()
def errors_of(run):
    """Mean error that each Gaussian shows, as a share of the mean error of the views [N]."""
    shown = summed = 0.0
    error, pixels = 0.0, 0
    rng = random.Random(run.state.step)
    chosen = rng.sample(list(run._datamanager.train_indices), min(VIEWS, len(run._datamanager.train_indices)))
    chosen = [index for index in chosen if index not in run._datamanager.held_out_indices] or chosen
    for camera, batch in run._datamanager.cameras(chosen):
        photo = run._photo(camera, batch)
        image = render_view(run.source, photo.camera, run.background, run.settings, depth=False)[0]["rgb"]
        wrong = (image - photo.target).abs().mean(dim=-1)
        inputs = pass_inputs(run.source.gaussians, photo.camera, run.settings)
        summed = summed + blending_weights(inputs, wrong, backend=run.settings.backend)
        shown = shown + blending_weights(inputs, backend=run.settings.backend)
        error, pixels = error + float(wrong.sum()), pixels + wrong.numel()
    return summed / shown.clamp_min(1e-6) / max(error / pixels, 1e-9)


if SHARE > 0:
    after_step, grow = Densification.after_step, CappedStrategy._grow_gs

    def noting(self, run):
        self.strategy.run = run
        after_step(self, run)

    def where_wrong(self, params, optimizers, state, step):
        right = errors_of(self.run) < SHARE
        before = len(params["means"])
        high = state["grad2d"] / state["count"].clamp_min(1) > self.grow_grad2d
        state["grad2d"][right] = 0
        result = grow(self, params, optimizers, state, step)
        if step % 1000 < 100:
            print(f"GROW step {step}: {before:,} Gaussians, {int(high.sum()):,} candidates, {int((high & ~right).sum()):,} grow", flush=True)
        return result

    Densification.after_step, CappedStrategy._grow_gs = noting, where_wrong

sys.argv[0] = str(Path(__file__).with_name("few_arms.py"))
runpy.run_path(sys.argv[0], run_name="__main__")
