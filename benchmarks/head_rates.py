"""At which learning rate does a head burst? Trained alone on the still field of a finished run, on a CPU too.

    python benchmarks/head_rates.py --load-config RUN/config.yml --seeds 1 2 3 4 5 6
    python benchmarks/head_rates.py --load-config RUN/config.yml --betas 0.9 0.999 --full-rate-inputs 1000000    # plain Adam
    python benchmarks/head_rates.py --load-config RUN/config.yml --size regular --pixel-unshuffle 1 --steps 300 --rise 100

A fresh head learns on random windows of the training views, at a rate that rises and then stays, which is harder than the
decay of ns-train. A sixth of the views is held back. A line for each seed goes to ``results/head_rates.jsonl``: steps whose
loss is more than 1.3 times that of base colours (``steps_above``), the loss over that of base colours and the longest gradient
in each tenth of the steps, and the gain in PSNR over base colours on the views held back.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import mean
from typing import NamedTuple

import run
import torch
from pytorch_msssim import SSIM
from rich.progress import track
from torch import Tensor

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.evaluation import psnr
from sundae_ns.scenes.opening import open_pipeline
from sundae_ns.training.losses import picture_loss
from sundae_ns.training.optimizers import NetworkAdamConfig

RESULTS = Path(__file__).parent / "results" / "head_rates.jsonl"
BURST = 1.3
HELD_BACK = 6


class Seen(NamedTuple):
    """A training view of the still field."""

    base: Tensor
    splatted: Tensor
    alpha: Tensor
    truth: Tensor

    def window(self, left: int, top: int, side: int) -> Seen:
        return Seen(*(picture[top : top + side, left : left + side].contiguous() for picture in self))

    def compensated(self, head: CompensationHead) -> Tensor:
        return head(self.base, self.splatted, self.alpha)


@torch.no_grad()
def training_views(path: Path, count: int) -> list[Seen]:
    opened = open_pipeline(path)
    model, data = opened.model, opened.pipeline.datamanager
    opened.pipeline.eval()
    cameras = list(data.training_views())
    views = []
    for i in torch.linspace(0, len(cameras) - 1, count).round().long().unique().tolist():
        view, background = model.view_of(cameras[i][0]), model._get_background_color()
        pictures, splatted = model.render(model.gaussians, view, background, depth=False)
        truth = model.composite_with_background(model.get_gt_img(data.cached_train[i]["image"]), background)
        views.append(Seen(pictures["base_rgb"], splatted.colors, splatted.alpha, truth))
    return views


def train(views: list[Seen], options: argparse.Namespace, seed: int) -> dict[str, object]:
    held_back = views[HELD_BACK - 1 :: HELD_BACK]
    views = [view for i, view in enumerate(views) if i % HELD_BACK != HELD_BACK - 1]
    torch.manual_seed(seed)
    features = views[0].splatted.shape[2] - 3
    config = HeadConfig(size=options.size, pixel_unshuffle=options.pixel_unshuffle, num_features=features)
    head = CompensationHead(config).to(views[0].base.device)
    adam = NetworkAdamConfig(
        lr=options.rate, eps=1e-8, betas=tuple(options.betas), full_rate_inputs=options.full_rate_inputs
    )
    optimizer = adam.setup(head.parameters())
    highest = [group["lr"] for group in optimizer.param_groups]
    ssim = SSIM(data_range=1.0, size_average=True, channel=3)
    chance = torch.Generator().manual_seed(seed)
    losses, norms = [], []
    for step in track(range(options.steps), description=f"Seed {seed}", transient=True):
        for group, rate in zip(optimizer.param_groups, highest, strict=True):
            group["lr"] = rate * min((step + 1) / (options.rise + 1), 1.0)
        optimizer.zero_grad()
        loss = of_base = 0.0
        for _ in range(options.batch):
            i, u, v = (torch.rand(3, generator=chance) * (1 - 1e-6)).tolist()
            whole = views[int(i * len(views))]
            height, width = whole.base.shape[:2]
            side = min(options.side, height, width)
            seen = whole.window(int(u * (width - side + 1)), int(v * (height - side + 1)), side)
            found = picture_loss(seen.compensated(head), seen.truth, ssim, 0.2) / options.batch
            found.backward()
            loss += float(found.detach())
            of_base += float(picture_loss(seen.base, seen.truth, ssim, 0.2)) / options.batch
        losses.append(loss / of_base)
        norms.append(float(torch.cat([p.grad.flatten() for p in head.parameters() if p.grad is not None]).norm()))
        optimizer.step()
    with torch.no_grad():
        gains = [float(psnr(v.compensated(head).clamp(0, 1), v.truth) - psnr(v.base, v.truth)) for v in held_back]
    stretch = max(options.steps // 10, 1)
    starts = range(0, options.steps, stretch)
    return {
        "seed": seed,
        "steps_above": sum(loss > BURST for loss in losses),
        "gain": round(mean(gains), 3),
        "loss": [round(mean(losses[start : start + stretch]), 3) for start in starts],
        "longest_gradient": [round(max(norms[start : start + stretch]), 2) for start in starts],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--load-config", type=Path, required=True)
    parser.add_argument("--size", default=HeadConfig.size)
    parser.add_argument("--pixel-unshuffle", type=int, default=2)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--betas", type=float, nargs=2, default=NetworkAdamConfig.betas)
    parser.add_argument("--full-rate-inputs", type=int, default=NetworkAdamConfig.full_rate_inputs)
    parser.add_argument("--batch", type=int, default=1, help="pictures of a step")
    parser.add_argument("--steps", type=int, default=2500)
    parser.add_argument("--rise", type=int, default=500, help="steps over which the rate rises")
    parser.add_argument("--side", type=int, default=96, help="of the windows, pixels")
    parser.add_argument("--views", type=int, default=64, help="training views, evenly chosen")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    if options.views < HELD_BACK:
        parser.error(f"every {HELD_BACK}th of the views is held back; give --views {HELD_BACK} or more")
    views = training_views(options.load_config, options.views)
    if len(views) < HELD_BACK:
        parser.error(f"every {HELD_BACK}th of the views is held back, and the capture has {len(views)}; take another")
    device = torch.cuda.get_device_name() if views[0].base.is_cuda else "cpu"
    said = "size pixel_unshuffle rate betas full_rate_inputs batch steps rise side".split()
    for seed in options.seeds:
        line = {"run": options.load_config.parents[2].name, **{name: getattr(options, name) for name in said}}
        line |= {**train(views, options, seed), "device": device, "commit": run.commit()}
        run.append_line(options.results, line)
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
