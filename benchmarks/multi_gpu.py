"""Train a field, tiled, on one, two and four GPUs: images a second, quality, memory of a GPU; print CSV rows.

    python benchmarks/multi_gpu.py --data DIR --gpus 1 2 --field warm.ckpt -o benchmarks/results/multi_gpu.csv
    python benchmarks/multi_gpu.py --data DIR --gpus 1 2 --field some.ply --primitives 2000 --steps 12 --cpu

Runs train ``--steps`` images on copies of the field side by side, without growing or pruning. Each run starts fresh
processes. Words that this script does not know are options of ``ns-train``. The second line tries it on a CPU.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from harness.job import configure, trainer_of
from harness.plan import Job, parser_of
from harness.rows import Rows
from sundae_ns.core.timing import now
from sundae_ns.io import checkpoint
from sundae_ns.io.formats import read_gaussians

WARM = 100
"""Images before the clock starts, whole batches of 1, 2 and 4 GPUs: kernels load, and memory is allocated."""
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
    """Train on one of several GPUs; the first prints a row, and puts it into the table."""
    cuda = not options.cpu
    if cuda:
        torch.cuda.set_device(rank)
    if ranks > 1:
        meeting = f"file://{folder / f'meeting-{ranks}'}"
        dist.init_process_group("nccl" if cuda else "gloo", init_method=meeting, rank=rank, world_size=ranks)
    config = config_of(options, extra, folder)
    config.machine.device_type, config.machine.num_devices = ("cuda" if cuda else "cpu"), ranks
    trainer, _ = trainer_of(config, rank, ranks)
    iterate, warm, started = trainer.train_iteration, WARM if cuda else 0, [0.0]
    images = options.steps - warm
    assert images > 0, "too few steps"

    def clock() -> float:
        if ranks > 1:
            dist.barrier()
        return now("cuda" if cuda else "cpu")

    def iteration(step: int) -> Any:
        if step == warm:
            started[:] = [clock()]
        return iterate(step)

    trainer.train_iteration = iteration
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    trainer.train()
    seconds = clock() - started[0]
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
            figures = (images, round(seconds, 2), round(images / seconds, 1))
            errors = (round(quality["psnr"], 3), round(quality["ssim"], 4))
            row = (name, ranks, device, trainer.model.source.total, *figures, *errors, round(max(memory)))
            Rows(options.out, COLUMNS, COLUMNS[:3]).put(dict(zip(COLUMNS, row, strict=True)))
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
    parser.add_argument("-o", "--out", type=Path, help="table of results")
    options, extra = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        gaussians = tile(read_gaussians(options.field)[0], options.primitives)
        state = {f"_model.gauss_params.{key}": value for key, value in gaussians.items()}
        checkpoint.write({"step": 0, "pipeline": state}, folder / "tiled.ckpt")
        del gaussians, state
        for ranks in options.gpus:
            torch.multiprocessing.spawn(measure, (ranks, folder, options, extra), nprocs=ranks)


if __name__ == "__main__":
    main()
