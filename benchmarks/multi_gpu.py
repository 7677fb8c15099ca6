"""Train one scene on one, two and four GPUs: images a second, quality, memory of each GPU; prints a CSV.

    python benchmarks/multi_gpu.py --data DIR                              # whole runs, then the tiled field
    python benchmarks/multi_gpu.py --data DIR --gpus 1 2 --only tiled --field warm.ckpt --primitives 10000000
    python benchmarks/multi_gpu.py --data DIR --gpus 1 2 --steps 60 --primitives 2000 --tiled-steps 12 --cpu

A whole run trains ``--steps`` images by ``--method``. The run on one GPU leaves its field right before the prune; the
tiled runs train ``--tiled-steps`` images on copies of it side by side, without growing or pruning. Each run starts
fresh processes. Words that this script does not know are options of ``ns-train``. The third line tries it on a CPU.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from harness.job import configure, trainer_of
from harness.plan import Job, parser_of
from sundae_ns.io import checkpoint
from sundae_ns.io.formats import read_gaussians

WARM = 100
"""Images before the clock starts on a tiled field: kernels load, and memory is allocated."""
COLUMNS = ("field", "gpus", "device", "primitives", "images", "seconds", "images_per_s", "psnr", "ssim", "peak_mib")


def tile(gaussians: dict[str, torch.Tensor], count: int) -> dict[str, torch.Tensor]:
    """Copies of a field side by side on the ground, cut to an exact count, in random order.

    A trained field is mixed too: with an order by position, one camera would see a whole shard and none of the others.
    """
    n = len(gaussians["means"])
    copies = -(-count // n)
    side = next(s for s in range(1, copies + 1) if s * s >= copies)
    low, high = torch.quantile(gaussians["means"][:: max(n // 10**5, 1)], torch.tensor([0.02, 0.98]), dim=0)
    # From the middle outwards, so that the cameras stand in the first copy.
    cells = sorted(((x, y) for x in range(side) for y in range(side)), key=max)[:copies]
    chosen = torch.randperm(copies * n, generator=torch.Generator().manual_seed(0))[:count]
    offsets = torch.tensor([[*cell, 0] for cell in cells]) * (high - low)
    tiled = {name: value[chosen % n] for name, value in gaussians.items()}
    tiled["means"] = tiled["means"] + offsets[chosen // n]
    return tiled


class Clock:
    """Wraps the trainer's iteration: images, and seconds of training alone."""

    def __init__(self, trainer: Any, ranks: int, warm: int, save: Path | None) -> None:
        self.trainer, self.ranks, self.warm, self.save = trainer, ranks, warm, save
        self.iterate, trainer.train_iteration = trainer.train_iteration, self
        self.seconds, self.images = 0.0, 0
        self.started: float | None = None

    def now(self) -> float:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        if self.ranks > 1:
            dist.barrier()
        return time.perf_counter()

    def pause(self) -> None:
        if self.started is not None:
            self.seconds, self.started = self.seconds + self.now() - self.started, None

    def __call__(self, step: int) -> Any:
        if self.save is not None and step == self.trainer.model.config.pruning.prune_at:
            self.pause()
            checkpoint.write({"step": step, "pipeline": self.trainer.pipeline.state_dict()}, self.save)
        if self.started is None and step >= self.warm and step % self.ranks == 0:
            self.started = self.now()
        self.images += self.started is not None
        return self.iterate(step)


def config_of(options: argparse.Namespace, extra: list[str], folder: Path, *, tiled: bool) -> Any:
    data, name = options.data.resolve(), "tiled" if tiled else "whole"
    steps = options.tiled_steps if tiled else options.steps
    job = Job(name, "whole", data.name, name, str(data), options.method, steps, seed=42)
    config: Any = configure(replace(job, options=tuple(extra), parser=parser_of(data)), folder)[0]
    model = config.pipeline.model
    model.evaluate_prune = False
    if model.pruning.decides:
        model.pruning.keep_ratio = 0.1  # several GPUs make no trials
    if tiled:
        model.warm_start, model.warm_start_frame = folder / "tiled.ckpt", "model"
        model.pruning.mode, model.stop_split_at = "off", 0
    return config


def measure(rank: int, ranks: int, folder: Path, options: argparse.Namespace, extra: list[str], tiled: bool) -> None:
    """Train on one of several GPUs; the first writes a row."""
    cuda, warm = not options.cpu, folder / "warm.ckpt"
    if cuda:
        torch.cuda.set_device(rank)
    if ranks > 1:
        meeting = f"file://{folder / f'meeting-{ranks}-{tiled}'}"
        dist.init_process_group("nccl" if cuda else "gloo", init_method=meeting, rank=rank, world_size=ranks)
    config = config_of(options, extra, folder, tiled=tiled)
    config.machine.device_type, config.machine.num_devices = ("cuda" if cuda else "cpu"), ranks
    trainer, _ = trainer_of(config, rank, ranks)
    save = warm if ranks == 1 and not tiled and not warm.exists() else None
    clock = Clock(trainer, ranks, WARM if tiled and cuda else 0, save)
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    trainer.train()
    clock.pause()
    memory: list[Any] = [torch.cuda.max_memory_allocated() / 2**20 if cuda else 0.0] * ranks
    if ranks > 1:
        dist.all_gather_object(memory, memory[0])
    with trainer.ranks.whole() as first:
        if first:
            trainer.model.lpips = lambda *_: None  # would download its weights
            trainer.pipeline.eval()
            quality = trainer.pipeline.get_average_eval_image_metrics()
            name = f"{options.data.name}, " + (f"tiled to {options.primitives}" if tiled else "whole run")
            device = torch.cuda.get_device_name(0) if cuda else "CPU"
            figures = (round(clock.seconds, 2), round(clock.images / clock.seconds, 1))
            errors = (round(quality["psnr"], 3), round(quality["ssim"], 4))
            row = (name, ranks, device, trainer.model.source.total, clock.images, *figures, *errors, round(max(memory)))
            with (folder / "rows.csv").open("a", newline="") as file:
                csv.writer(file).writerow(row)
    if ranks > 1:
        dist.barrier()
        dist.destroy_process_group()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="sundae")
    parser.add_argument("--data", type=Path, required=True, help="folder of a capture")
    parser.add_argument("--gpus", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--only", choices=("whole", "tiled"), help="one of both parts; tiled needs --field")
    parser.add_argument("--steps", type=int, default=30_000, help="images of a whole run")
    parser.add_argument("--tiled-steps", type=int, default=2000, help="images of a run on the tiled field")
    parser.add_argument("--field", type=Path, help="a field to tile: a checkpoint or a .ply; default the whole run's")
    parser.add_argument("--primitives", type=int, default=10_000_000, help="of the tiled field")
    parser.add_argument("--cpu", action="store_true", help="try it out over gloo")
    options, extra = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for tiled in (False, True):
            if options.only == ("whole" if tiled else "tiled"):
                continue
            if tiled:
                gaussians = tile(read_gaussians(options.field or folder / "warm.ckpt")[0], options.primitives)
                state = {f"_model.gauss_params.{key}": value for key, value in gaussians.items()}
                checkpoint.write({"step": 0, "pipeline": state}, folder / "tiled.ckpt")
                del gaussians, state
            for ranks in options.gpus:
                torch.multiprocessing.spawn(measure, (ranks, folder, options, extra, tiled), nprocs=ranks)
        rows = (folder / "rows.csv").read_text()
    csv.writer(sys.stdout).writerow(COLUMNS)
    print(rows, end="", flush=True)


if __name__ == "__main__":
    main()
