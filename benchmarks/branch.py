"""Compare variants of the head, or of training after the prune, from one pruned field; append a JSON line for each.

    python benchmarks/run.py sundae --scene fox --data DIR --steps 15001 --save-pruned     # makes the pruned field once
    python benchmarks/branch.py compact --scene fox --data DIR --field RUN/nerfstudio_models --steps 4000
    python benchmarks/branch.py no-head --scene fox --data DIR --field ... -- --pipeline.model.head.mode off
    python benchmarks/branch.py full-resolution-skip --scene fox --data DIR --field ... --skip 8

All branches share the warm-up and the prune, so that they differ in nothing but what is compared; rates decay over the
branch. Everything after ``--`` goes to ``ns-train``'s parser. The other options are experiments that the product has no
option for, because they lost: their figures are the reason.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import run
import torch
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from sundae_ns.compensation import CompensationHead
from sundae_ns.compensation.head import SIZES
from sundae_ns.evaluation import psnr

RESULTS = Path(__file__).parent / "results" / "branches.jsonl"
FIELD = ("features_dc", "features_rest", "opacities", "scales", "quats", "features")


@dataclass
class CooldownConfig(SchedulerConfig):
    """The rate stays, and falls to almost nothing over the last share of the branch."""

    _target: type = field(default_factory=lambda: Cooldown)
    steps: int = 0
    share: float = 0.25


class Cooldown(Scheduler):
    config: CooldownConfig

    def get_scheduler(self, optimizer: torch.optim.Optimizer, lr_init: float) -> LambdaLR:
        steps, share = self.config.steps, self.config.share
        return LambdaLR(optimizer, lr_lambda=lambda s: min(1.0, max(0.02, (steps - s) / (share * steps))))


class FullResolutionSkip(nn.Module):
    """The U-Net passes channels to two convolutions at full resolution, which see the splatted image as well."""

    def __init__(self, net: nn.Module, in_channels: int, channels: int) -> None:
        super().__init__()
        self.net = net
        fold = net.pixel_unshuffle**2
        net.out = nn.Conv2d(net.out.in_channels, channels * fold, 1)
        self.fine = nn.Sequential(
            nn.Conv2d(channels + in_channels, 16, 3, padding=1), nn.LeakyReLU(0.1), nn.Conv2d(16, 3, 3, padding=1)
        )
        nn.init.zeros_(self.fine[2].weight)
        nn.init.zeros_(self.fine[2].bias)

    def forward(self, image: Tensor) -> Tensor:
        return self.fine(torch.cat([self.net(image), image], dim=1))


def flipped(head_run: Any) -> Any:
    """The head sees mirrored pictures at random while it trains."""

    def wrapped(self: CompensationHead, image: Tensor) -> Tensor:
        sides = [side for side in (2, 3) if self.training and torch.rand(()) < 0.5]
        return head_run(self, image.flip(sides)).flip(sides) if sides else head_run(self, image)

    return wrapped


def parse() -> tuple[argparse.Namespace, list[str]]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--field", type=Path, required=True, help="checkpoint of a pruned field")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--out", type=Path, default=Path("outputs/branches"))
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--skip", type=int, help="channels passed to a branch at full resolution")
    parser.add_argument("--width", type=int, help="channels of the compact head's finest level")
    parser.add_argument("--flip", action="store_true", help="mirror pictures at random for the head")
    parser.add_argument("--rates", type=float, default=1.0, help="factor on the field's learning rates")
    parser.add_argument("--cooldown", type=float, help="share of the branch over which the field's rates fall")
    own, extra = sys.argv[1:], []
    if "--" in own:
        cut = own.index("--")
        own, extra = own[:cut], own[cut + 1 :]
    return parser.parse_args(own), extra


@torch.no_grad()
def training_views(pipeline: Any, count: int = 16) -> dict[str, float]:
    """Mean PSNR over some training views, which shows how far a head is fitted to them."""
    data, model = pipeline.datamanager, pipeline.model
    chosen = range(0, len(data.train_dataset), max(1, len(data.train_dataset) // count))
    sums = {"train_psnr": 0.0, "train_psnr_base": 0.0}
    for i in chosen:
        outputs = model.get_outputs_for_camera(data.train_dataset.cameras[i : i + 1].to(model.device))
        target = model.get_gt_img(data.cached_train[i]["image"])
        sums["train_psnr"] += float(psnr(outputs["rgb"], target)) / len(chosen)
        sums["train_psnr_base"] += float(psnr(outputs["base_rgb"], target)) / len(chosen)
    return sums


def main() -> None:
    options, extra = parse()
    options.method, options.variant = "sundae", options.name
    extra = ["--pipeline.model.warm-start", str(options.field), "--pipeline.model.pruning.mode", "off", *extra]
    config, command = run.configure(options, extra)
    for group in config.optimizers.values():
        if group["scheduler"] is not None:
            group["scheduler"].max_steps = options.steps
    for name in FIELD:
        config.optimizers[name]["optimizer"].lr *= options.rates
        if options.cooldown is not None:
            config.optimizers[name]["scheduler"] = CooldownConfig(steps=options.steps, share=options.cooldown)
    if options.width is not None:
        SIZES["compact"] = (options.width, SIZES["compact"][1])
    if options.flip:
        CompensationHead._run = flipped(CompensationHead._run)  # type: ignore[method-assign]
    if options.skip is not None:
        built = CompensationHead.__init__

        def with_skip(self: CompensationHead, head: Any) -> None:
            built(self, head)
            inputs = head.num_features + (4 if head.mode == "residual" else 0)
            self.net = FullResolutionSkip(self.net, inputs, options.skip)  # type: ignore[assignment]
            self._graphed.net = self.net

        CompensationHead.__init__ = with_skip  # type: ignore[method-assign]
    run._set_random_seed(options.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.save_checkpoint = lambda step: None
    trainer.train()
    trainer.pipeline.eval()
    line = {
        "name": options.name,
        "scene": options.scene,
        "steps": options.steps,
        "seed": options.seed,
        "primitives": trainer.pipeline.model.num_points,
        **run.evaluate(trainer.pipeline),
        **training_views(trainer.pipeline),
        "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else "",
        "commit": run.commit(),
        "command": command.replace(str(options.field), "PRUNED"),
        "experiments": {key: getattr(options, key) for key in ("skip", "width", "flip", "rates", "cooldown")},
    }
    options.results.parent.mkdir(parents=True, exist_ok=True)
    with open(options.results, "a") as file:
        file.write(json.dumps(line) + "\n")
    print("branch:", line)


if __name__ == "__main__":
    main()
