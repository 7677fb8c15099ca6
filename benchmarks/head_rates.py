"""Does a head of several ranks burst at its learning rate? Trained alone on a finished run's field, in batches of pictures.

    python benchmarks/head_rates.py --load-config RUN/config.yml --rate 2e-3 --batch 4 --power 4    # four ranks, scaled
    python benchmarks/head_rates.py --load-config RUN/config.yml --rate 1e-3 --batch 4 --power 1    # as one GPU has it

A fresh head learns on the still field, on windows of 160 pixels a side, on any device. ``--power`` is that of Adam's two
betas. A line goes to ``results/head_rates.jsonl``: the mean loss of each stretch of 50 steps, and the longest gradient in it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from rich.progress import track

from sundae_ns import model as model_module
from sundae_ns.compensation import CompensationHead, Window
from sundae_ns.opening import open_pipeline

RESULTS = Path(__file__).parent / "results" / "head_rates.jsonl"
SIDE, STRETCH, WARMUP = 160, 50, 500


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--load-config", type=Path, required=True)
    parser.add_argument("--rate", type=float, required=True)
    parser.add_argument("--batch", type=int, default=4, help="pictures of a step, as many as there would be ranks")
    parser.add_argument("--power", type=int, default=1)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    opened = open_pipeline(options.load_config, data=None, test_mode="val")
    pipeline, model = opened.pipeline, opened.model
    assert model.head is not None
    torch.manual_seed(0)
    model.head.load_state_dict(CompensationHead(model.head.config).state_dict())
    corners = torch.Generator().manual_seed(0)

    def window(width: int, height: int, *_: Any, **__: Any) -> Window:
        u, v = torch.rand(2, generator=corners).tolist()
        return Window(int(u * (width - SIDE)), int(v * (height - SIDE)), SIDE, SIDE)

    model_module.training_window = window
    pipeline.train()
    for value in model.gauss_params.values():
        value.requires_grad_(False)
    betas = (0.9**options.power, 0.999**options.power)
    optimizer = torch.optim.Adam(model.head.parameters(), lr=options.rate, betas=betas, eps=1e-8)
    losses, norms = [], []
    for step in track(range(options.steps), description="Steps"):
        optimizer.param_groups[0]["lr"] = options.rate * min((step + 1) / (WARMUP // options.batch + 1), 1.0)
        optimizer.zero_grad()
        total = 0.0
        for picture in range(options.batch):
            model.step = opened.step + 1 + step * options.batch + picture
            loss = pipeline.get_train_loss_dict(model.step)[1]["main_loss"] / options.batch
            loss.backward()
            total += loss.item()
        grads = [value.grad.flatten() for value in model.head.parameters() if value.grad is not None]
        losses.append(total)
        norms.append(float(torch.cat(grads).norm()))
        optimizer.step()
    starts = range(0, options.steps, STRETCH)
    line = {
        "run": opened.config.experiment_name,
        **{name: getattr(options, name) for name in ("rate", "batch", "power", "steps")},
        "loss": [round(mean(losses[start : start + STRETCH]), 4) for start in starts],
        "longest_gradient": [round(max(norms[start : start + STRETCH]), 3) for start in starts],
    }
    with options.results.open("a") as file:
        file.write(json.dumps(line) + "\n")
    print(line)


if __name__ == "__main__":
    main()
