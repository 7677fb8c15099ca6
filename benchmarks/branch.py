"""Compare variants of the head, or of training after the prune, from one pruned field; append a JSON line and a row for each.

    python benchmarks/run.py sundae --scene fox --data DIR --steps 15001 --save-pruned     # makes the pruned field once
    python benchmarks/branch.py compact --scene fox --data DIR --field RUN/nerfstudio_models --steps 4000
    python benchmarks/branch.py no-head --scene fox --data DIR --field ... -- --pipeline.model.head.mode off
    python benchmarks/branch.py full-resolution-skip --scene fox --data DIR --field ... --skip 8

All branches share the warm-up and the prune, so that they differ in nothing but what is compared; rates decay over the
branch. Everything after ``--`` goes to ``ns-train``'s parser. The other options are experiments that the product has no
option for: those that have figures lost (``results/branches.jsonl``); ``--window`` and ``--halved`` have not been run.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import run
import torch
import torch.nn.functional as F
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from sundae_ns.compensation import CompensationHead
from sundae_ns.compensation.head import SIZES
from sundae_ns.evaluation import RunRow, append_row, psnr
from sundae_ns.evaluation.timing import now
from sundae_ns.model import SundaeModel
from sundae_ns.rendering import render as rendering
from sundae_ns.scenes.measure import sizes
from sundae_ns.storage import Sizes
from sundae_ns.training.losses import picture_loss

RESULTS = Path(__file__).parent / "results" / "branches.jsonl"
FIELD = ("features_dc", "features_rest", "opacities", "scales", "quats", "features")

EXPERIMENTS = (
    "every window halved skip width flip rates cooldown picture_loss_on_base apart average weight_decay dropout".split()
)


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

    def wrapped(self: CompensationHead, image: Tensor, dtype: torch.dtype) -> Tensor:
        sides = [side for side in (2, 3) if self.training and torch.rand(()) < 0.5]
        return head_run(self, image.flip(sides), dtype).flip(sides) if sides else head_run(self, image, dtype)

    return wrapped


def with_dropout(forward: Any, share: float) -> Any:
    """Whole feature channels are hidden from the head at random while it trains."""

    def wrapped(self: CompensationHead, base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
        if torch.is_grad_enabled():
            kept = (torch.rand_like(splatted[0, 0]) >= share) / (1 - share)
            kept[:3] = 1
            splatted = splatted * kept
        return forward(self, base, splatted, alpha)

    return wrapped


def now_and_then(head_active: Any, every: int) -> Any:
    """In training the head takes part in every so many-th step; the others train base colours by themselves."""
    return property(lambda self: head_active.fget(self) and not (self.training and self.step % every))


def in_window(forward: Any, share: float) -> Any:
    """In training the head sees a random band of rows; outside of it base colours have the loss of the picture."""

    def wrapped(self: CompensationHead, base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
        if not torch.is_grad_enabled():
            return forward(self, base, splatted, alpha)
        height, fold = len(base), self.config.pixel_unshuffle
        rows = max(int(height * share) // fold, 1) * fold
        top = int(torch.randint(0, (height - rows) // fold + 1, ())) * fold
        band = slice(top, top + rows)
        seen = [picture[band].contiguous() for picture in (base, splatted, alpha)]
        return torch.cat([base[:top], forward(self, *seen), base[top + rows :]])

    return wrapped


def with_halved_features(forward: Any) -> Any:
    """All pixels of a block of 2 x 2 have the same features, their mean."""

    def wrapped(self: CompensationHead, base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
        height, width = base.shape[:2]
        features = splatted[..., 3:].permute(2, 0, 1)[None]
        padded = F.pad(features, (0, width % 2, 0, height % 2), mode="replicate")
        coarse = F.avg_pool2d(padded, 2).repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
        again = coarse[0, :, :height, :width].permute(1, 2, 0)
        return forward(self, base, torch.cat([splatted[..., :3], again], dim=-1), alpha)

    return wrapped


def with_picture_loss_on_base(get_loss_dict: Any) -> Any:
    """Base colours get the whole loss of a picture, instead of L1 alone."""

    def wrapped(self: SundaeModel, outputs: Any, batch: Any, metrics: Any = None) -> dict[str, Tensor]:
        losses = get_loss_dict(self, outputs, batch, metrics)
        if "base_loss" in losses:
            target = self._target(batch, outputs)
            loss = picture_loss(outputs["base_rgb"], target, self.ssim, self.config.ssim_lambda)
            losses["base_loss"] = self.config.base_loss_weight * loss
        return losses

    return wrapped


def apart(splat: Any) -> Any:
    """The head's loss moves features and head only: what it sees of the field has no gradients."""

    def wrapped(params: Any, view: Any, channels: Tensor, style: rendering.Style, **options: Any) -> Any:
        if not style.training or channels.shape[1] == 3:
            return splat(params, view, channels, style, **options)
        seen = splat(params, view, channels[:, :3], style, **options)
        still = {name: value.detach() for name, value in params.items()}
        features = splat(still, view, channels[:, 3:], style, render_depth=False)
        return replace(seen, colors=torch.cat([seen.colors, features.colors], dim=-1))

    return wrapped


def unmoved(forward: Any) -> Any:
    """The head adds to base colours without moving them."""

    def wrapped(self: CompensationHead, base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
        splatted = torch.cat([splatted[..., :3].detach(), splatted[..., 3:]], dim=-1)
        return forward(self, base.detach(), splatted, alpha.detach())

    return wrapped


class Averaged:
    """Exponential moving average of all parameters, taken after each step."""

    def __init__(self, model: SundaeModel, decay: float) -> None:
        self.model, self.decay = model, decay
        self.values = {name: value.detach().clone() for name, value in model.named_parameters()}

    @torch.no_grad()
    def update(self, step: int) -> None:
        decay = min(self.decay, (1 + step) / (10 + step))
        for name, value in self.model.named_parameters():
            self.values[name].lerp_(value, 1 - decay)

    @torch.no_grad()
    def take(self) -> None:
        for name, value in self.model.named_parameters():
            value.copy_(self.values[name])


class Clock:
    """Milliseconds a step, the device waited for at both ends, once pictures are cached and kernels compiled."""

    first = 100

    def __init__(self, trainer: Any) -> None:
        self.trainer = trainer
        self.started: float | None = None
        self.ms_step: float | None = None
        """None where there were too few steps."""

    def tick(self, step: int) -> None:
        last = self.trainer.config.max_num_iterations - 1
        if step == self.first:
            self.started = now(self.trainer.device)
        elif step == last and self.started is not None:
            self.ms_step = (now(self.trainer.device) - self.started) / (last - self.first) * 1e3


def profiled(trainer: Any, steps: range) -> dict[str, Any]:
    """Milliseconds that the GPU works in a step, by kernel, and how many it is given; a few more steps are made for it."""
    trainer.pipeline.train()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        for step in steps:
            trainer.train_iteration(step)
        now(trainer.device)
    # Not the host's calls, nor ranges that somebody marked, whose kernels are there already.
    on_gpu = torch.autograd.DeviceType.CUDA
    events = [e for e in profile.key_averages() if e.device_type == on_gpu and not e.is_user_annotation]
    kernels: dict[str, float] = defaultdict(float)
    for event in events:  # templates whose names differ in what is cut off are one
        kernels[event.key[:100]] += event.self_device_time_total / len(steps) / 1e3
    longest = sorted(kernels.items(), key=lambda kernel: kernel[1], reverse=True)[:20]
    return {
        "gpu_ms": sum(kernels.values()),
        "launches": sum(event.count for event in events) / len(steps),
        "kernels": {name: round(ms, 4) for name, ms in longest},
    }


def after_each_step(trainer: Any, fn: Any) -> None:
    train_iteration = trainer.train_iteration

    def wrapped(step: int) -> Any:
        result = train_iteration(step)
        fn(step)
        return result

    trainer.train_iteration = wrapped


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
    parser.add_argument("--rows", default=str(run.RESULTS), help="CSV to append a row to, or - for none")
    parser.add_argument("--save", action="store_true", help="keep the final checkpoint, and config.yml for other tools")
    parser.add_argument("--profile", type=int, default=0, help="steps more under a profiler, for GPU ms by kernel")
    parser.add_argument("--skip", type=int, help="channels passed to a branch at full resolution")
    parser.add_argument("--width", type=int, help="channels of the wide head's finest level")
    parser.add_argument("--flip", action="store_true", help="mirror pictures at random for the head")
    parser.add_argument("--rates", type=float, default=1.0, help="factor on the field's learning rates")
    parser.add_argument("--cooldown", type=float, help="share of the branch over which the field's rates fall")
    parser.add_argument("--picture-loss-on-base", action="store_true", help="SSIM too in the loss of base colours")
    parser.add_argument("--apart", action="store_true", help="the head's loss does not move the field")
    parser.add_argument("--average", type=float, help="decay of a moving average of all parameters, which is evaluated")
    parser.add_argument("--weight-decay", type=float, help="decoupled, of the head's weights, times its rate")
    parser.add_argument("--every", type=int, help="steps from one in which the head takes part to the next")
    parser.add_argument(
        "--window", type=float, help="share of a picture's rows that the head sees; others train base colours"
    )
    parser.add_argument("--halved", action="store_true", help="features as if splatted at half the resolution")
    parser.add_argument("--dropout", type=float, help="share of feature channels hidden from the head at random")
    own, extra = sys.argv[1:], []
    if "--" in own:
        cut = own.index("--")
        own, extra = own[:cut], own[cut + 1 :]
    options = parser.parse_args(own)
    if options.save and options.average is not None:
        parser.error("--save keeps what was trained, and --average evaluates a mean of it; leave one of the two out")
    if options.profile and not torch.cuda.is_available():
        parser.error("--profile counts a GPU's milliseconds, and there is none here; leave it out")
    return options, extra


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


def row(line: dict[str, Any], bytes_: Sizes, resolution: str) -> RunRow:
    """What ``runs.csv`` has of a branch: no frame of it is timed, and its share is that of a prune of its own, if any."""
    share = re.search(r"pruning\.keep-ratio (\S+)", line["command"])
    changed = [(key, value) for key, value in line["experiments"].items() if value and (key, value) != ("rates", 1.0)]
    flags = [f"--{key.replace('_', '-')}" + ("" if value is True else f" {value}") for key, value in changed]
    return RunRow(
        **{key: line[key] for key in ("scene", "seed", "steps", "primitives", "gpu", "commit")},
        **{key: line[key] for key in ("psnr", "ssim", "psnr_base", "ssim_base")},
        method="sundae",
        variant=f"branch: {line['name']}",
        keep_ratio=None if share is None else float(share[1]),
        bytes_primitives=bytes_.primitives,
        bytes_head=bytes_.head,
        bytes_total=bytes_.total,
        train_s=line.get("train_s"),
        resolution=resolution,
        command=line["command"] + (f" (branch.py {' '.join(flags)})" if flags else ""),
    )


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
        SIZES["wide"] = (options.width, SIZES["wide"][1])
    if options.flip:
        CompensationHead._layers = flipped(CompensationHead._layers)  # type: ignore[method-assign]
    if options.picture_loss_on_base:
        SundaeModel.get_loss_dict = with_picture_loss_on_base(SundaeModel.get_loss_dict)  # type: ignore[method-assign]
    if options.dropout is not None:
        CompensationHead.forward = with_dropout(CompensationHead.forward, options.dropout)  # type: ignore[method-assign]
    if options.every is not None:
        SundaeModel.head_active = now_and_then(SundaeModel.head_active, options.every)  # type: ignore[method-assign]
    if options.window is not None:
        CompensationHead.forward = in_window(CompensationHead.forward, options.window)  # type: ignore[method-assign]
    if options.halved:
        CompensationHead.forward = with_halved_features(CompensationHead.forward)  # type: ignore[method-assign]
    if options.apart:
        rendering.splat = apart(rendering.splat)
        CompensationHead.forward = unmoved(CompensationHead.forward)  # type: ignore[method-assign]
    if options.skip is not None:
        built = CompensationHead.__init__

        def with_skip(self: CompensationHead, head: Any) -> None:
            built(self, head)
            inputs = head.num_features + (4 if head.mode == "residual" else 0)
            self.net = FullResolutionSkip(self.net, inputs, options.skip)  # type: ignore[assignment]
            self._can_fuse = False

        CompensationHead.__init__ = with_skip  # type: ignore[method-assign]
    run._set_random_seed(options.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    save = trainer.save_checkpoint
    trainer.save_checkpoint = lambda step: save(step) if options.save and step == options.steps - 1 else None
    if options.save:
        config.save_config()
    averaged = None if options.average is None else Averaged(trainer.pipeline.model, options.average)
    if averaged is not None:
        after_each_step(trainer, averaged.update)
    if options.weight_decay is not None:
        optimizer = trainer.optimizers.optimizers["compensation"]

        @torch.no_grad()
        def decay(step: int) -> None:
            for group in optimizer.param_groups:
                torch._foreach_mul_(group["params"], 1 - group["lr"] * options.weight_decay)

        after_each_step(trainer, decay)
    clock = Clock(trainer)
    after_each_step(trainer, clock.tick)
    started = now(trainer.device)
    trainer.train()
    seconds = now(trainer.device) - started
    if averaged is not None:
        averaged.take()
    trainer.pipeline.eval()
    line = {
        "name": options.name,
        "scene": options.scene,
        "steps": options.steps,
        "seed": options.seed,
        "primitives": trainer.pipeline.model.num_points,
        "train_s": seconds,
        "ms_step": clock.ms_step,
        **run.evaluate(trainer.pipeline),
        **training_views(trainer.pipeline),
        "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else "",
        "commit": run.commit(),
        "command": command.replace(str(options.field), "PRUNED"),
        "experiments": {key: getattr(options, key) for key in EXPERIMENTS},
    }
    if options.profile:
        line |= profiled(trainer, range(options.steps, options.steps + options.profile))
    run.append_line(options.results, line)
    if options.rows != "-":
        append_row(Path(options.rows), row(line, sizes(trainer.pipeline.model), run.resolution(trainer.pipeline)))
    print("branch:", line)


if __name__ == "__main__":
    main()
