"""Train several times with the same seed, and say how far the results are apart; print one JSON line.

    python benchmarks/spread.py --runs 5 --device cuda >> benchmarks/results/reliability/spread.jsonl
    python benchmarks/spread.py --runs 3 --steps 90 --size 48 --points 300          # on a CPU: no spread at all
    python benchmarks/spread.py --runs 5 --device cuda --method sundae --data ../shared/scenes/bonsai --steps-scale 0.05

Without ``--data`` the embedded scene is trained on. Every run starts anew from the same seed and trains to the end; the
figures are PSNR over the test views, counts, and whether all tensors are equal bit for bit.

Fields that have grown apart number their primitives differently, so the selection is compared on one field: the first run's
checkpoint right before its prune, which as many fresh trainers load, take one step from and prune. ``selection_overlap`` is
the share of the kept primitives that two of them have in common, the mean and the least over all pairs.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from itertools import combinations
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import torch
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.scripts.train import _set_random_seed
from nerfstudio.utils import profiler, writer
from rich.progress import track

from sundae_ns.data import write_scene
from sundae_ns.distributed import shorten
from sundae_ns.evaluation import psnr
from sundae_ns.pruning import cutting

NEVER = 10**9


def configured(options: argparse.Namespace, data: Path, folder: Path) -> Any:
    arguments = [options.method, "--data", str(data), "--machine.seed", str(options.seed)]
    if not (data / "transforms.json").exists():
        arguments += ["colmap", "--colmap-path", "sparse/0", "--downscale-factor", "1"]
        arguments += ["--eval-mode", "interval", "--eval-interval", "8"]
    config: Any = tyro.cli(AnnotatedBaseConfigUnion, args=arguments)
    scale = options.steps / config.max_num_iterations if options.steps else options.steps_scale
    config = shorten(config, 1 / scale)  # type: ignore[arg-type]
    config.machine.device_type = options.device
    config.pipeline.datamanager.data = data
    config.output_dir, config.timestamp, config.vis = folder, "now", "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.pipeline.model.evaluate_prune = False
    config.steps_per_save = config.steps_per_eval_batch = NEVER
    config.steps_per_eval_image = config.steps_per_eval_all_images = NEVER
    return config


@contextmanager
def started(config: Any) -> Iterator[Any]:
    """A trainer with the seed of its configuration, and nothing of it left in nerfstudio's globals afterwards."""
    _set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    try:
        yield trainer
    finally:
        writer.EVENT_WRITERS.clear()
        writer.EVENT_STORAGE.clear()
        writer.GLOBAL_BUFFER.clear()
        profiler.PROFILER.clear()


@contextmanager
def masks() -> Iterator[list[torch.Tensor]]:
    """What every prune keeps, while it lasts."""
    found: list[torch.Tensor] = []
    original = cutting.keep

    def keep(params: Any, optimizers: Any, states: Any, mask: torch.Tensor) -> Any:
        found.append(mask.cpu().clone())
        return original(params, optimizers, states, mask)

    cutting.keep = keep  # type: ignore[assignment]
    try:
        yield found
    finally:
        cutting.keep = original


@torch.no_grad()
def quality(pipeline: Any) -> float:
    """Mean PSNR over the test views, dB."""
    pipeline.eval()
    model = pipeline.model
    values = []
    for camera, batch in pipeline.datamanager.fixed_indices_eval_dataloader:
        picture = model.get_outputs_for_camera(camera)["rgb"]
        truth = model.composite_with_background(model.get_gt_img(batch["image"]), model._get_background_color())
        values.append(float(psnr(picture, truth)))
    return mean(values)


def spread_of(values: list[float]) -> dict[str, Any]:
    return {
        "mean": round(mean(values), 4),
        "sd": round(stdev(values), 4),
        "range": round(max(values) - min(values), 4),
        "each": [round(value, 4) for value in values],
    }


def whole_runs(options: argparse.Namespace, data: Path, folder: Path) -> tuple[dict[str, Any], Path]:
    """Train to the end, as often as asked for; the figures, and the first run's checkpoint right before its prune."""
    psnrs, before, after, seconds = [], [], [], []
    tensors: list[dict[str, torch.Tensor]] = []
    warm: Path | None = None
    for number in track(range(options.runs), description="Training", transient=True):
        config = configured(options, data, folder / f"run-{number}")
        prune_at = config.pipeline.model.pruning.prune_at
        began = time.perf_counter()
        with started(config) as trainer, masks() as kept:
            iterate = trainer.train_iteration

            def watched(step: int, trainer: Any = trainer, iterate: Any = iterate, at: int = prune_at) -> Any:
                if step == at:
                    trainer.save_checkpoint(at - 1)
                return iterate(step)

            if number == 0:
                trainer.train_iteration = watched
                warm = trainer.checkpoint_dir / f"step-{prune_at - 1:09d}.ckpt"
                config.save_only_latest_checkpoint = False
            trainer.train()
            psnrs.append(quality(trainer.pipeline))
            before.append(float(len(kept[0])))
            after.append(float(trainer.pipeline.model.num_points))
            state = trainer.pipeline.state_dict()
            tensors.append({name: value.cpu() for name, value in state.items() if isinstance(value, torch.Tensor)})
            device, rasterizer = trainer.device, trainer.pipeline.model.backend.name
        seconds.append(time.perf_counter() - began)
    assert warm is not None
    result = {
        "method": options.method,
        "scene": data.name,
        "device": torch.cuda.get_device_name(0) if "cuda" in str(device) else "cpu",
        "rasterizer": rasterizer,
        "seed": options.seed,
        "runs": options.runs,
        "steps": config.max_num_iterations,
        "prune_at": prune_at,
        "psnr": spread_of(psnrs),
        "primitives_before": spread_of(before),
        "primitives": spread_of(after),
        "bit_for_bit": all(
            other.keys() == tensors[0].keys() and all(torch.equal(other[name], tensors[0][name]) for name in other)
            for other in tensors[1:]
        ),
        "seconds_a_run": round(mean(seconds), 1),
    }
    return result, warm


def selections(options: argparse.Namespace, data: Path, folder: Path, warm: Path) -> list[float]:
    """Prune one field as often as asked for; the share in common of every two selections."""
    kept = []
    for number in track(range(options.runs), description="Pruning one field", transient=True):
        config = configured(options, data, folder / f"prune-{number}")
        config.load_checkpoint, config.max_num_iterations = warm, 1
        with started(config) as trainer, masks() as found:
            trainer.train()
        rows = torch.arange(len(found[0]))
        for mask in found:  # one of primitives that are not finite may come first
            rows = rows[mask]
        kept.append(torch.zeros(len(found[0]), dtype=torch.bool).index_fill_(0, rows, True))
    return [int((a & b).sum()) / int(a.sum()) for a, b in combinations(kept, 2)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--method", default="sundae-tiny", help="one that prunes once")
    parser.add_argument("--data", type=Path, help="a capture; the embedded scene by default")
    parser.add_argument("--steps", type=int, help="length of a run; everything else is scaled to it")
    parser.add_argument(
        "--steps-scale", type=float, default=1.0, help="the same, as a share of the method's own length"
    )
    parser.add_argument("--size", type=int, default=128, help="side of the embedded scene's pictures, pixels")
    parser.add_argument("--points", type=int, default=2000, help="of the embedded scene's sparse cloud")
    options = parser.parse_args()
    if options.runs < 2:
        parser.error("--runs takes at least 2: a spread is between runs")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name, redirect_stdout(sys.stderr):
        folder = Path(name)
        data = options.data
        if data is None:
            data = write_scene(
                folder / "embedded", width=options.size, height=options.size, points=options.points, train_views=24
            )
        result, warm = whole_runs(options, data, folder)
        shares = selections(options, data, folder, warm)
    result["selection_overlap"] = {"mean": round(mean(shares), 5), "least": round(min(shares), 5)}
    print(json.dumps(result))


if __name__ == "__main__":
    main()
