"""Train one scene on one, two and four GPUs: images a second, quality after as many images, memory of each GPU.

    python benchmarks/multi_gpu.py --data DIR --gpus 1 2 4 --save-field warm.ckpt
    python benchmarks/multi_gpu.py --data DIR --gpus 1 2 4 --field warm.ckpt --primitives 10000000
    python benchmarks/multi_gpu.py --data DIR --gpus 1 2 --field FIELD --primitives 2000 --steps 12 --cpu

The first line trains whole runs. ``--steps`` counts images, the same on any number of GPUs. Test views are rendered
``--looks`` times on the way; the clock stands still meanwhile. The second line trains ``--steps`` images (default 2000)
on a field tiled from another one, without growing or pruning it. The third line tries the script out on a CPU. Each run
starts fresh processes and prints one JSON line, which belongs in results/multi_gpu.jsonl.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from nerfstudio.scripts.train import _set_random_seed

from harness.job import configure
from harness.plan import Job, parser_of
from sundae_ns.evaluation import psnr
from sundae_ns.storage.runs import checkpoint

WARM = 100
"""Images before the clock starts on a tiled field: kernels load, and memory is allocated."""


def tile(field: dict[str, torch.Tensor], count: int) -> dict[str, torch.Tensor]:
    """Copies of a field side by side on the ground, cut to an exact count, in random order.

    A trained field is mixed too: with an order by place, one camera would see a whole shard and nothing of the others.
    """
    n = len(field["means"])
    copies = -(-count // n)
    side = next(s for s in range(1, copies + 1) if s * s >= copies)
    low, high = torch.quantile(field["means"][:: max(n // 10**5, 1)], torch.tensor([0.02, 0.98]), dim=0)
    # From the middle outwards, so that the cameras stand in the first copy.
    places = sorted(((x, y) for x in range(side) for y in range(side)), key=max)[:copies]
    chosen = torch.randperm(copies * n, generator=torch.Generator().manual_seed(0))[:count]
    offsets = torch.tensor([[*place, 0] for place in places]) * (high - low)
    tiled = {name: value[chosen % n] for name, value in field.items()}
    tiled["means"] = tiled["means"] + offsets[chosen // n]
    return tiled


@torch.no_grad()
def test_psnr(pipeline: Any) -> float:
    """Mean PSNR over all test views, dB."""
    values = []
    for camera, batch in pipeline.datamanager.fixed_indices_eval_dataloader:
        outputs = pipeline.model.get_outputs_for_camera(camera)
        values.append(float(psnr(outputs["rgb"], pipeline.model.get_gt_img(batch["image"]))))
    return sum(values) / len(values)


class Clock:
    """Wraps the trainer's iteration: seconds of training alone, and the test PSNR at even distances."""

    def __init__(self, trainer: Any, ranks: int, looks: int, warm: int, save: Path | None) -> None:
        self.trainer, self.ranks, self.warm, self.save = trainer, ranks, warm, save
        self.iterate, trainer.train_iteration = trainer.train_iteration, self
        every = max(trainer.config.max_num_iterations // looks, 1) if looks else 0
        self.looks = {every * (i + 1) for i in range(looks)}
        self.curve: dict[int, float] = {}
        self.seconds, self.images = 0.0, 0
        self.started: float | None = None

    def _now(self) -> float:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        if self.ranks > 1:
            dist.barrier()
        return time.perf_counter()

    def pause(self) -> None:
        if self.started is not None:
            self.seconds += self._now() - self.started
            self.started = None

    def __call__(self, step: int) -> Any:
        if step in self.looks:
            self.pause()
            self.look(step)
        if self.save is not None and self.ranks == 1 and step == self.trainer.pipeline.model.config.pruning.prune_at:
            self.pause()
            checkpoint.write({"step": step, "pipeline": self.trainer.pipeline.state_dict()}, self.save)
        if self.started is None and step * self.ranks >= self.warm:
            self.started = self._now()
        if self.started is not None:
            self.images += self.ranks
        return self.iterate(step)

    def look(self, step: int) -> None:
        pipeline = self.trainer.pipeline
        pipeline.model.source.agree(pipeline.model.state)
        pipeline.eval()
        self.curve[step * self.ranks] = round(test_psnr(pipeline), 3)
        pipeline.train()


def measure(rank: int, ranks: int, meeting: str, options: argparse.Namespace, extra: list[str]) -> None:
    """Train on one of several GPUs; the first prints the figures."""
    config, command = configure(job_of(options, extra), options.out)
    cuda = not options.cpu
    config.machine.device_type, config.machine.num_devices = ("cuda" if cuda else "cpu"), ranks
    if cuda:
        torch.cuda.set_device(rank)
    if ranks > 1:
        dist.init_process_group(
            "nccl" if cuda else "gloo", init_method=f"file://{meeting}", rank=rank, world_size=ranks
        )
    if options.field is not None:
        model: Any = config.pipeline.model
        model.warm_start, model.warm_start_frame = Path(meeting).with_name("tiled.ckpt"), "model"
        model.pruning.mode, model.stop_split_at, model.evaluate_prune = "off", 0, False
    _set_random_seed(config.machine.seed + rank)
    trainer: Any = config.setup(local_rank=rank, world_size=ranks)
    trainer.setup()
    trainer.save_checkpoint = lambda step: None
    clock = Clock(trainer, ranks, options.looks, WARM if options.field is not None and cuda else 0, options.save_field)
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    trainer.train()
    clock.pause()
    memory = [torch.cuda.max_memory_allocated() / 2**20 if cuda else 0.0]
    if ranks > 1:
        every: list[Any] = [0.0] * ranks
        dist.all_gather_object(every, memory[0])
        memory = every
    clock.look(trainer.step + 1)
    if rank == 0:
        name = torch.cuda.get_device_name(0) if cuda else "CPU"
        line = {
            "scene": options.data.resolve().name,
            "variant": "multi-gpu" if options.field is None else f"multi-gpu-tiled-{options.primitives}",
            "gpu": name if ranks == 1 else f"{ranks} x {name}",
            "ranks": ranks,
            "primitives": trainer.pipeline.model.source.total,
            "images": clock.images,
            "seconds": round(clock.seconds, 2),
            "images_per_s": round(clock.images / clock.seconds, 1),
            "psnr_after_images": clock.curve,
            "peak_mib": [round(peak) for peak in memory],
            "command": f"python benchmarks/multi_gpu.py {shlex.join(sys.argv[1:])} ({command})",
        }
        print(json.dumps(line), flush=True)
    if ranks > 1:
        dist.barrier()
        dist.destroy_process_group()


def job_of(options: argparse.Namespace, extra: list[str]) -> Job:
    """The training as a job of a comparison."""
    data = options.data.resolve()
    steps = options.steps
    if steps is None:
        steps = 30_000 if options.field is None else 2000
    return Job(
        *("multi-gpu", "whole", data.name, "multi-gpu", str(data), options.method, steps, options.seed),
        options=tuple(extra),
        parser=parser_of(data),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="sundae")
    parser.add_argument("--data", type=Path, required=True, help="folder of a capture")
    parser.add_argument("--gpus", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--steps", type=int, help="number of images (default 30,000, tiled 2000)")
    parser.add_argument("--field", type=Path, help="a field to tile: a checkpoint, a folder of them, or a .ply")
    parser.add_argument(
        "--save-field", type=Path, help="write the field of one GPU right before its prune, for --field"
    )
    parser.add_argument("--primitives", type=int, default=10_000_000, help="of the tiled field")
    parser.add_argument("--looks", type=int, help="times that test views are rendered on the way (default 12, tiled 0)")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks"))
    parser.add_argument("--cpu", action="store_true", help="try it out over gloo")
    known, extra = parser.parse_known_args()
    if known.looks is None:
        known.looks = 12 if known.field is None else 0
    with tempfile.TemporaryDirectory() as folder:
        if known.field is not None:
            field = tile(checkpoint.read_field(known.field)[0], known.primitives)
            state = {"step": 0, "pipeline": {f"_model.gauss_params.{name}": value for name, value in field.items()}}
            checkpoint.write(state, Path(folder) / "tiled.ckpt")
            del field, state
        for ranks in known.gpus:
            meeting = str(Path(folder) / f"meeting-{ranks}")
            torch.multiprocessing.spawn(measure, (ranks, meeting, known, extra), nprocs=ranks)


if __name__ == "__main__":
    main()
