"""One scene on one, two and four GPUs: pictures a second, quality after as many pictures, memory of each GPU.

    python benchmarks/multi_gpu.py --scene bonsai --data ../shared/scenes/bonsai --gpus 1 2 4 --save-field warm.ckpt
    python benchmarks/multi_gpu.py --scene bonsai --data ... --gpus 1 2 4 --field warm.ckpt --primitives 10000000
    python benchmarks/multi_gpu.py --scene bonsai --data ... --gpus 1 2 --field ... --primitives 2000 --steps 12 --cpu

The first line trains whole runs. ``--steps`` counts pictures, the same on any number of GPUs, and test views are rendered
``--looks`` times on the way, which says after how many pictures a quality is reached; those times are not counted. The
second trains ``--steps`` pictures (default 2000) on a field that is made by tiling another one, without growing or pruning it.
Each run starts fresh processes. A row goes to ``results/runs.csv`` (gpu = "2 x ..."), and a line with the curve and the memory
of every rank to ``results/multi_gpu.jsonl``. The third line tries the script out on a CPU, and records nothing.
"""

from __future__ import annotations

import argparse
import json
import shlex
import tempfile
import time
from pathlib import Path
from typing import Any

import run
import torch
import torch.distributed as dist
from nerfstudio.scripts.train import _set_random_seed

from sundae_ns.evaluation import RunRow, append_row
from sundae_ns.scenes.measure import sizes
from sundae_ns.storage.runs import checkpoint

LINES = run.RESULTS.parent / "multi_gpu.jsonl"
WARM = 100
"""Pictures before the clock starts on a tiled field: kernels load, and memory is asked for."""


def tile(field: dict[str, torch.Tensor], count: int) -> dict[str, torch.Tensor]:
    """Copies of a field side by side on the ground, cut to an exact count, in random order.

    Random, since a field that has grown is mixed too: shards that are corners of the scene would be seen by one camera
    all at once.
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


class Clock:
    """Wraps the trainer's iteration: seconds of training alone, and the quality at even distances."""

    def __init__(self, trainer: Any, ranks: int, looks: int, warm: int, save: Path | None) -> None:
        self.trainer, self.ranks, self.warm, self.save = trainer, ranks, warm, save
        self.iterate, trainer.train_iteration = trainer.train_iteration, self
        every = max(trainer.config.max_num_iterations // looks, 1) if looks else 0
        self.looks = {every * (i + 1) for i in range(looks)}
        self.curve: dict[int, float] = {}
        self.heads_apart: dict[int, float] = {}
        self.seconds, self.pictures = 0.0, 0
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
            checkpoint.save({"step": step, "pipeline": self.trainer.pipeline.state_dict()}, self.save)
        if self.started is None and step * self.ranks >= self.warm:
            self.started = self._now()
        if self.started is not None:
            self.pictures += self.ranks
        return self.iterate(step)

    def look(self, step: int) -> dict[str, float]:
        pipeline = self.trainer.pipeline
        if self.ranks > 1:
            self.trainer.shards.agree_on_focal(pipeline.model)
            head = pipeline.model.head
            self.heads_apart[step * self.ranks] = self.trainer.shards.apart(() if head is None else head.parameters())
        pipeline.eval()
        quality = run.evaluate(pipeline)
        pipeline.train()
        self.curve[step * self.ranks] = quality["psnr"]
        return quality


def measure(rank: int, ranks: int, meeting: str, options: argparse.Namespace, extra: list[str]) -> None:
    config, command = run.configure(options, extra)
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
    peak = torch.cuda.max_memory_allocated() / 2**20 if cuda else 0.0
    memory = [peak]
    if ranks > 1:
        memory = [0.0] * ranks
        dist.all_gather_object(memory, peak)
    model = trainer.pipeline.model
    quality = clock.look(trainer.step + 1)
    if rank == 0:
        name = torch.cuda.get_device_name(0) if cuda else "CPU"
        gpu = name if ranks == 1 else f"{ranks} x {name}"
        speed = clock.pictures / clock.seconds
        print(f"{gpu}: {speed:.2f} pictures/s, PSNR {quality['psnr']:.3f} dB, {max(memory):,.0f} MiB of a GPU at most")
        if cuda:
            record(options, trainer, quality, clock, memory, gpu, command)
    if ranks > 1:
        dist.barrier()
        dist.destroy_process_group()


def record(
    options: argparse.Namespace,
    trainer: Any,
    quality: dict[str, float],
    clock: Clock,
    memory: list[float],
    gpu: str,
    command: str,
) -> None:
    model, config = trainer.pipeline.model, options
    reports = trainer.base_dir / "prune.json"
    pruned = json.loads(reports.read_text()) if reports.exists() else []
    command += f" --machine.num-devices {clock.ranks}"
    ours = "python benchmarks/multi_gpu.py " + shlex.join(config.shown)
    bytes_ = sizes(model) if clock.ranks == 1 else None
    append_row(
        options.results,
        RunRow(
            scene=options.scene,
            method=options.method,
            variant=options.variant,
            keep_ratio=model.config.pruning.keep_ratio if pruned else 1.0,
            seed=options.seed,
            steps=trainer.config.max_num_iterations * clock.ranks,
            primitives=model.total_points,
            psnr=quality["psnr"],
            ssim=quality["ssim"],
            psnr_base=quality["psnr_base"],
            ssim_base=quality["ssim_base"],
            bytes_primitives=bytes_.primitives if bytes_ else 0,
            bytes_head=bytes_.head if bytes_ else 0,
            bytes_total=bytes_.total if bytes_ else 0,
            train_s=clock.seconds,
            prune_s=sum(report["seconds"] for report in pruned),
            peak_primitives=model.pruning_state["peak"],
            peak_vram_mib=max(memory),
            gpu=gpu,
            resolution=run.resolution(trainer.pipeline),
            commit=run.commit(),
            command=f"{ours} ({command})",
        ),
    )
    line = {
        "scene": options.scene,
        "variant": options.variant,
        "gpu": gpu,
        "ranks": clock.ranks,
        "primitives": model.total_points,
        "pictures": clock.pictures,
        "seconds": clock.seconds,
        "pictures_per_s": clock.pictures / clock.seconds,
        "psnr_after_pictures": clock.curve,
        "heads_apart": clock.heads_apart,
        "peak_mib": memory,
        "commit": run.commit(),
        "command": ours,
    }
    run.append_line(LINES, line)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="sundae")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--gpus", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--steps", type=int, help="pictures")
    parser.add_argument("--field", type=Path, help="a field to tile: a checkpoint, a folder of them, or a .ply")
    parser.add_argument("--save-field", type=Path, help="write what one GPU has right before its prune, for --field")
    parser.add_argument("--primitives", type=int, default=10_000_000, help="of the tiled field")
    parser.add_argument("--looks", type=int, help="times that test views are rendered on the way (default 12, tiled 0)")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks"))
    parser.add_argument("--results", type=Path, default=run.RESULTS)
    parser.add_argument("--cpu", action="store_true", help="try it out over gloo")
    known, extra = parser.parse_known_args()
    known.variant = "multi-gpu" if known.field is None else f"multi-gpu-tiled-{known.primitives}"
    if known.field is not None and known.steps is None:
        known.steps = 2000
    if known.looks is None:
        known.looks = 12 if known.field is None else 0
    known.shown = [
        *("--scene", known.scene, "--data", known.scene, "--gpus", *map(str, known.gpus), "--looks", str(known.looks)),
        *(() if known.steps is None else ("--steps", str(known.steps))),
        *(() if known.field is None else ("--field", known.field.name, "--primitives", str(known.primitives))),
        *extra,
    ]
    with tempfile.TemporaryDirectory() as folder:
        if known.field is not None:
            field = tile(checkpoint.read_field(known.field)[0], known.primitives)
            state = {"step": 0, "pipeline": {f"_model.gauss_params.{name}": value for name, value in field.items()}}
            checkpoint.save(state, Path(folder) / "tiled.ckpt")
            del field, state
        for ranks in known.gpus:
            meeting = str(Path(folder) / f"meeting-{ranks}")
            torch.multiprocessing.spawn(measure, (ranks, meeting, known, extra), nprocs=ranks)


if __name__ == "__main__":
    main()
