"""Train a field, tiled, on one, two and four GPUs: images a second, quality, memory of a GPU; print a CSV.

    python benchmarks/multi_gpu.py --data DIR --gpus 1 2 --field warm.ckpt --primitives 10000000
    python benchmarks/multi_gpu.py --data DIR --gpus 1 2 --field some.ply --primitives 2000 --steps 12 --cpu

Runs train ``--steps`` images on copies of the field side by side, without growing or pruning. Each run starts fresh
processes. Words that this script does not know are options of ``ns-train``. The second line tries it on a CPU.
The table belongs in results/multi_gpu.csv.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from harness.job import configure, trainer_of
from harness.plan import Job, parser_of
from sundae_ns.core.timing import now
from sundae_ns.io import checkpoint
from sundae_ns.io.formats import read_gaussians

WARM = 100
"""Images before the clock starts: kernels load, and memory is allocated."""
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

    def __init__(self, trainer: Any, ranks: int, warm: int) -> None:
        self.ranks, self.warm, self.images = ranks, warm, 0
        self.iterate, trainer.train_iteration = trainer.train_iteration, self
        self.started: float | None = None

    def now(self) -> float:
        if self.ranks > 1:
            dist.barrier()
        return now("cuda" if torch.cuda.is_available() else "cpu")

    def __call__(self, step: int) -> Any:
        if self.started is None and step >= self.warm and step % self.ranks == 0:
            self.started = self.now()
        self.images += self.started is not None
        return self.iterate(step)


def config_of(options: argparse.Namespace, extra: list[str], folder: Path) -> Any:
    data = options.data.resolve()
    job = Job("tiled", "whole", data.name, "tiled", str(data), options.method, options.steps, seed=42)
    config: Any = configure(replace(job, options=tuple(extra), parser=parser_of(data)), folder)[0]
    model = config.pipeline.model
    model.evaluate_prune = False
    model.warm_start, model.warm_start_frame = folder / "tiled.ckpt", "model"
    model.pruning.mode, model.stop_split_at = "off", 0
    return config


def measure(rank: int, ranks: int, folder: Path, options: argparse.Namespace, extra: list[str]) -> None:
    """Train on one of several GPUs; the first writes a row."""
    cuda = not options.cpu
    if cuda:
        torch.cuda.set_device(rank)
    if ranks > 1:
        meeting = f"file://{folder / f'meeting-{ranks}'}"
        dist.init_process_group("nccl" if cuda else "gloo", init_method=meeting, rank=rank, world_size=ranks)
    config = config_of(options, extra, folder)
    config.machine.device_type, config.machine.num_devices = ("cuda" if cuda else "cpu"), ranks
    trainer, _ = trainer_of(config, rank, ranks)
    clock = Clock(trainer, ranks, WARM if cuda else 0)
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    trainer.train()
    assert clock.started is not None, "too few steps"
    seconds = clock.now() - clock.started
    memory: list[Any] = [torch.cuda.max_memory_allocated() / 2**20 if cuda else 0.0] * ranks
    if ranks > 1:
        dist.all_gather_object(memory, memory[0])
    with trainer.ranks.gathered() as first:
        if first:
            trainer.model.lpips = lambda *_: None  # would download its weights
            trainer.pipeline.eval()
            quality = trainer.pipeline.get_average_eval_image_metrics()
            name = f"{options.data.name}, tiled to {options.primitives}"
            device = torch.cuda.get_device_name(0) if cuda else "CPU"
            figures = (round(seconds, 2), round(clock.images / seconds, 1))
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
    parser.add_argument("--steps", type=int, default=2000, help="images of a run")
    parser.add_argument("--field", type=Path, required=True, help="a field to tile: a checkpoint or a .ply")
    parser.add_argument("--primitives", type=int, default=10_000_000, help="of the tiled field")
    parser.add_argument("--cpu", action="store_true", help="try it out over gloo")
    options, extra = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        gaussians = tile(read_gaussians(options.field)[0], options.primitives)
        state = {f"_model.gauss_params.{key}": value for key, value in gaussians.items()}
        checkpoint.write({"step": 0, "pipeline": state}, folder / "tiled.ckpt")
        del gaussians, state
        for ranks in options.gpus:
            torch.multiprocessing.spawn(measure, (ranks, folder, options, extra), nprocs=ranks)
        rows = (folder / "rows.csv").read_text()
    csv.writer(sys.stdout).writerow(COLUMNS)
    print(rows, end="", flush=True)


if __name__ == "__main__":
    main()
