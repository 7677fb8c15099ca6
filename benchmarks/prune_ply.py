"""How much of a run's base colours each camera-free rule of ``sundae prune`` keeps; one JSON line a rule and ratio.

python benchmarks/prune_ply.py --run RUN --views 4 --keep 0.5 0.2
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch

from sundae_ns.evaluation import psnr
from sundae_ns.gaussians import FEATURES
from sundae_ns.pruning import PruningConfig, decide, footprint
from sundae_ns.scenes.opening import load_run

RULES: list[dict[str, Any]] = [
    {"score": "random"},
    {"score": "opacity", "selection": "top"},
    {"score": "response", "selection": "band", "signal": "positions"},
    {"score": "contribution", "selection": "sampled"},
    {"score": "response-contribution", "selection": "sampled"},
    {"score": "contribution", "selection": "systematic"},
    {"score": "response-contribution", "selection": "systematic"},
]


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--keep", type=float, nargs="+", default=[0.5, 0.2])
    options = parser.parse_args()

    run = load_run(options.run / "config.yml")
    model = run.model
    whole = {name: value.detach().clone() for name, value in model.gauss_params.items()}
    field = {name: value for name, value in whole.items() if name != FEATURES}
    views = torch.linspace(0, len(run.cameras) - 1, options.views).long().tolist()

    def quality(mask: torch.Tensor) -> float:
        for name, value in whole.items():
            model.gauss_params[name].data = value[mask]
        pictures = [model.get_outputs_for_camera(run.cameras[i])["base_rgb"] for i in views]
        return sum(float(psnr(picture, run.truths[i])) for picture, i in zip(pictures, views, strict=True)) / len(views)

    everything = torch.ones(len(field["means"]), dtype=torch.bool, device=model.device)
    print(json.dumps({"rule": None, "keep": 1.0, "psnr": round(quality(everything), 2)}))
    for keep in options.keep:
        for rule in RULES:
            decision = decide(field, PruningConfig(keep_ratio=keep, **rule), lambda: footprint(field))
            print(json.dumps({"rule": rule, "keep": keep, "psnr": round(quality(decision.mask), 2)}), flush=True)


if __name__ == "__main__":
    main()
