"""Whether the head helps in every test view, and what would tell those where it does harm: one JSON object for a run.

    python benchmarks/single_views.py --load-config RUN/config.yml --out benchmarks/results/single_views.json

For each test view: PSNR of base colours and with the head; how much of what the head sees lies outside of the ranges that
training views have, channel by channel, and PSNR with that clamped to them; and PSNR without the low frequencies of the
correction, those that Gaussian blurs of several widths leave. Means over the views go first.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from rich.progress import track
from torch import Tensor
from torchvision.transforms.functional import gaussian_blur

from sundae_ns.evaluation import psnr
from sundae_ns.opening import open_pipeline

RESULTS = Path(__file__).parent / "results" / "single_views.json"
SIGMAS = (1, 2, 4, 8, 16)


class Inputs:
    """Sees what the head is given, and clamps it where there are bounds."""

    def __init__(self, head: torch.nn.Module) -> None:
        self.splatted: Tensor | None = None
        self.bounds: tuple[Tensor, Tensor] | None = None
        head.register_forward_pre_hook(self._hook)

    def _hook(self, _: torch.nn.Module, inputs: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        base, splatted, alpha = inputs
        self.splatted = splatted.detach()
        return inputs if self.bounds is None else (base, splatted.clamp(*self.bounds), alpha)

    @property
    def pixels(self) -> Tensor:
        """``[H W, C]`` of the last picture."""
        if self.splatted is None:
            raise SystemExit("the head was not asked; was the run saved before its head took part?")
        return self.splatted.flatten(0, 1)


def low_frequencies(picture: Tensor, sigma: int) -> Tensor:
    """What a Gaussian blur leaves of ``[H, W, 3]``."""
    planes = picture.permute(2, 0, 1)[None]
    reach = min(3 * sigma, (min(planes.shape[2:]) - 1) // 2)  # the padding reflects the picture
    return gaussian_blur(planes, 2 * reach + 1, sigma)[0].permute(1, 2, 0)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--load-config", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    opened = open_pipeline(options.load_config)
    model, data = opened.model, opened.pipeline.datamanager
    opened.pipeline.eval()
    if model.head is None:
        raise SystemExit("this run has no head")
    inputs, background = Inputs(model.head), model._get_background_color()

    def rendered(camera: Any) -> tuple[Tensor, Tensor]:
        pictures, _ = model.render(model.gaussians, model.view_of(camera.to(model.device)), background, depth=False)
        return pictures["base_rgb"], pictures["rgb"].clamp(0, 1)

    lows, highs = [], []
    cameras = data.train_dataset.cameras
    for i in track(range(len(cameras)), description="Training views"):
        rendered(cameras[i : i + 1])
        lows.append(inputs.pixels.amin(0))
        highs.append(inputs.pixels.amax(0))
    low, high = torch.stack(lows).amin(0), torch.stack(highs).amax(0)
    views = []
    for camera, batch in track(data.fixed_indices_eval_dataloader, description="Test views"):
        truth = model.composite_with_background(model.get_gt_img(batch["image"]), background)
        base, shown = rendered(camera)
        beyond = ((inputs.pixels < low) | (inputs.pixels > high)).any(dim=1)
        inputs.bounds = low, high
        clamped = rendered(camera)[1]
        inputs.bounds = None
        line = {
            "base": float(psnr(base, truth)),
            "shown": float(psnr(shown, truth)),
            "pixels_beyond": float(beyond.float().mean()),
            "clamped": float(psnr(clamped, truth)),
        }
        for sigma in SIGMAS:
            rest = (shown - low_frequencies(shown - base, sigma)).clamp(0, 1)
            line[f"without_low_{sigma}"] = float(psnr(rest, truth))
        views.append(line)
    means = {name: mean(view[name] for view in views) for name in views[0]}
    options.out.write_text(json.dumps({"mean": means, "views": views}, indent=1) + "\n")
    print(means)


if __name__ == "__main__":
    main()
