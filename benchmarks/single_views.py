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

import torch
from nerfstudio.cameras.cameras import Cameras
from rich.progress import track
from torch import Tensor
from torchvision.transforms.functional import gaussian_blur

from sundae_ns.evaluation import psnr
from sundae_ns.rasterization import Rasterization
from sundae_ns.scenes.opening import open_pipeline, views_to_test

RESULTS = Path(__file__).parent / "results" / "single_views.json"
SIGMAS = (1, 2, 4, 8, 16)


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
    if model.head is None or model.head.config.mode != "residual":
        raise SystemExit("this run has no head that corrects base colours; give one with head.mode residual")
    background = model._get_background_color()

    def rendered(camera: Cameras) -> tuple[Tensor, Tensor, Rasterization]:
        """Base colours, the picture with the head, and what it saw ``[H, W, C]``."""
        view = model.view_of(camera.to(model.device))
        pictures, splatted = model.render(model.gaussians, view, background, depth=False)
        return pictures["base_rgb"], pictures["rgb"].clamp(0, 1), splatted

    lows, highs = [], []
    for camera, _ in track(list(data.training_views()), description="Training views"):
        pixels = rendered(camera)[2].colors.flatten(0, 1)
        lows.append(pixels.amin(0))
        highs.append(pixels.amax(0))
    low, high = torch.stack(lows).amin(0), torch.stack(highs).amax(0)
    views = []
    for camera, truth in track(list(zip(*views_to_test(model, data), strict=True)), description="Test views"):
        base, shown, splatted = rendered(camera)
        beyond = ((splatted.colors < low) | (splatted.colors > high)).any(dim=-1)
        clamped = model.head(base, splatted.colors.clamp(low, high), splatted.alpha).clamp(0, 1)
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
