"""A run's pictures at other sizes than it was trained at, against the truth resized alike.

    python benchmarks/scales.py --load-config RUN/config.yml

For each factor: PSNR of base colours, of the head as it is shown (at the trained scale, its correction resized), and of the
head run on the picture itself. Writes results/scales.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch

from sundae_ns.compensation import resize
from sundae_ns.evaluation import psnr
from sundae_ns.opening import load_run

RESULTS = Path(__file__).parent / "results" / "scales.json"
FACTORS = (0.25, 0.4, 0.5, 0.7, 0.9, 1.0, 1.1, 1.37, 2.0, 3.0)


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
        sums = dict.fromkeys(("base", "shown", "on_the_picture"), 0.0)
        for camera, truth in zip(cameras, truths, strict=True):
            view = model.view_of(camera).zoomed(factor)
            target = truth if factor == 1 else resize(truth, view.height, view.width)
            for name, focal in (("shown", trained), ("on_the_picture", None)):
                model.trained_focal = focal
                pictures, _ = model.render(model.gaussians, view, background, depth=False)
                sums[name] += float(psnr(pictures["rgb"], target)) / len(cameras)
            sums["base"] += float(psnr(pictures["base_rgb"], target)) / len(cameras)
        model.trained_focal = trained
        lines.append({"factor": factor, "width": view.width, "height": view.height, **sums})
        print(lines[-1], flush=True)
    options.out.write_text(json.dumps(lines, indent=2) + "\n")


if __name__ == "__main__":
    main()
