"""A run's pictures at other sizes than it was trained at, against the truth resized alike.

    python benchmarks/scales.py --load-config RUN/config.yml

For each factor, means over the test views: PSNR of base colours, of the head as it is shown (at the trained scale, its
correction resized), and of the head run on the picture itself; SSIM of the first two. And how single views fare: the least
gain of what is shown over base colours in dB, and how many views lose. Writes results/scales.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import mean

import torch

from sundae_ns.compensation import resize
from sundae_ns.evaluation import psnr, ssim, without_nan
from sundae_ns.scenes.opening import load_run

RESULTS = Path(__file__).parent / "results" / "scales.json"
FACTORS = (0.25, 0.4, 0.5, 0.7, 0.9, 0.98, 1.0, 1.02, 1.1, 1.37, 2.0, 3.0)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--load-config", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    run = load_run(options.load_config)
    model, cameras, truths = run.model, run.cameras, run.truths
    background, trained = model._get_background_color(), model.trained_focal
    lines = []
    for factor in FACTORS:
        found: dict[str, list[float]] = {
            name: [] for name in ("base", "shown", "on_the_picture", "ssim_base", "ssim_shown")
        }
        for camera, truth in zip(cameras, truths, strict=True):
            view = model.view_of(camera).zoomed(factor)
            target = truth if factor == 1 else resize(truth, view.height, view.width)
            for name, focal in (("on_the_picture", None), ("shown", trained)):  # what is shown last, for SSIM
                model.trained_focal = focal
                pictures, _ = model.render(model.gaussians, view, background, depth=False)
                found[name].append(float(psnr(pictures["rgb"], target)))
            found["base"].append(float(psnr(pictures["base_rgb"], target)))
            found["ssim_base"].append(float(ssim(pictures["base_rgb"], target)))
            found["ssim_shown"].append(float(ssim(pictures["rgb"], target)))
        gains = [shown - base for shown, base in zip(found["shown"], found["base"], strict=True)]
        line = {
            "factor": factor,
            "width": view.width,
            "height": view.height,
            **{name: mean(values) for name, values in found.items()},
            "worst_gain": min(gains),
            "worse_views": sum(gain < 0 for gain in gains),
            "views": len(gains),
        }
        lines.append(without_nan(line))
        print(lines[-1], flush=True)
    options.out.write_text(json.dumps(lines, indent=2, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
