"""Train far past the prune, or open many scenes in one process, and watch memory; print one JSON line.

    python benchmarks/memory_growth.py                                            # 2,000 steps on a CPU
    python benchmarks/memory_growth.py --scenes 200                               # load, render, prune and save each
    python benchmarks/memory_growth.py --device cuda --size 256 --points 20000    # with gsplat
    python benchmarks/memory_growth.py --device cuda --scenes 200 --points 20000

Samples every 50 steps, from 200 past the prune, or after every round of scenes, from the third on; growth is the slope
of the line through the samples. Exits with 1 if the host's resident memory, or torch's allocated or reserved memory on
the GPU, grows by more than ``--allowed`` bytes a step or a scene. With ``--scenes``, the memory that Python and numpy
traced counts too.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import sys
import tempfile
import tracemalloc
from contextlib import redirect_stdout, suppress
from copy import deepcopy
from itertools import cycle, islice, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ray_tracing import write_still_life

import sundae_ns as sn
from sundae_ns.api.files import SUFFIXES
from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.gaussians import FEATURES
from sundae_ns.method_configs import sundae_tiny
from sundae_ns.storage import checkpoint

PRUNE_AT, SETTLE, EVERY = 60, 200, 50
M_ARENA_MAX = -8
WARM_UP = 2
"""Rounds of scenes that are not sampled: they compile loops and fill caches."""
Samples = list[tuple[float, ...]]


def resident() -> int:
    """Resident memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def glibc(name: str, *arguments: int) -> None:
    """Call a function of glibc's allocator; nothing where there is another."""
    with suppress(OSError, AttributeError):
        getattr(ctypes.CDLL(None), name)(*arguments)


def memory(cuda: bool) -> tuple[int, ...]:
    """Bytes in use: of the host, and on a GPU what torch has allocated and reserved."""
    gc.collect()
    glibc("malloc_trim", 0)
    return (resident(), torch.cuda.memory_allocated(), torch.cuda.memory_reserved()) if cuda else (resident(),)


# ------------------------------------------------------------------------------------------------------------- training


def configured(options: argparse.Namespace, folder: Path) -> Any:
    scene = write_still_life(
        folder / "scene",
        train_views=8,
        test_views=2,
        width=options.size,
        height=options.size,
        points=options.points,
        samples=1,
    )
    config: Any = deepcopy(sundae_tiny.config)
    config.machine.device_type = options.device
    config.data = config.pipeline.datamanager.data = scene
    config.output_dir, config.timestamp = folder / "out", "now"
    config.viewer.quit_on_train_completion = True
    config.max_num_iterations = PRUNE_AT + options.steps + 1
    config.steps_per_save = 500
    config.pipeline.model.pruning.prune_at = PRUNE_AT
    config.pipeline.model.warmup_length = 5
    return config


def train(options: argparse.Namespace, folder: Path) -> tuple[Samples, dict[str, Any]]:
    """Samples of memory by step, and what was trained."""
    samples: Samples = []
    trainer = configured(options, folder).setup(local_rank=0, world_size=1)
    trainer.setup()
    iterate = trainer.train_iteration

    def watched(step: int) -> Any:
        if step >= PRUNE_AT + SETTLE and step % EVERY == 0:
            samples.append((step, *memory(options.device == "cuda")))
        return iterate(step)

    trainer.train_iteration = watched
    trainer.train()
    model = trainer.pipeline.model
    about = {"steps_past_the_prune": options.steps, "image": f"{options.size}x{options.size}"}
    return samples, {**about, "primitives": model.num_points, "rasterizer": model.backend.name}


# --------------------------------------------------------------------------------------------------------------- scenes


def files(folder: Path, points: int) -> list[Path]:
    """Scenes of all formats and SH degrees, of several sizes, and a run of splatfacto; the packed one has a head."""
    generator = torch.Generator().manual_seed(0)
    paths = []
    for degree, suffix in enumerate((".ply", ".spz", ".sog", ".sundae")):
        n = points * (1 + degree)
        cloud = torch.rand(n, 6, generator=generator)
        scene = sn.Scene.from_points(cloud[:, :3], cloud[:, 3:], sh_degree=degree)
        if suffix == ".sundae":
            field = scene.field.replaced({FEATURES: torch.randn(n, 5, generator=generator)})
            scene = sn.Scene(field, CompensationHead(HeadConfig(size="tiny", num_features=5)), trained_focal=(50, 60))
        paths.append(folder / f"{degree}{suffix}")
        sn.save(scene, paths[-1])
    run = folder / "run"
    state = {f"_model.gauss_params.{name}": value for name, value in scene.field.items() if name != FEATURES}
    checkpoint.write({"step": 0, "pipeline": state}, run / "nerfstudio_models" / "step-000000000.ckpt")
    (run / "config.yml").write_text("pipeline:\n  model: {}\n")
    return [*paths, run]


def open_scenes(options: argparse.Namespace, folder: Path) -> tuple[Samples, dict[str, Any]]:
    """Samples of memory by scene, the last one of each being what Python and numpy hold; and what was done."""
    samples: Samples = []
    sources = files(folder, options.points)
    tracemalloc.start()
    round_of = list(product(sources, SUFFIXES))
    for number, (source, suffix) in enumerate(islice(cycle(round_of), options.scenes), start=1):
        scene = sn.load(source, device=options.device)
        view = sn.View.look_at((2.0, 2.0, 2.0), (0.5, 0.5, 0.5), width=options.size, height=options.size)
        sn.render(scene, view)
        pruned = sn.prune(scene, keep=0.3, views=sn.virtual_views(scene, 2, seed=number, size=32))
        sn.save(pruned, folder / f"out{suffix}")
        del scene, pruned
        if number % len(round_of) == 0:
            samples.append((number, *memory(options.device == "cuda"), tracemalloc.get_traced_memory()[0]))
    about = {"scenes": options.scenes, "image": f"{options.size}x{options.size}", "primitives": options.points}
    tracemalloc.stop()
    return samples[WARM_UP:], about


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--steps", type=int, default=2000, help="steps past the prune")
    parser.add_argument("--scenes", type=int, help="open this many scenes in place of a training, at least 100")
    parser.add_argument("--size", type=int, default=64, help="side of an image, pixels")
    parser.add_argument("--points", type=int, default=300, help="of the sparse cloud, or of the smallest scene")
    allowed = "bytes a step or a scene; an image of 64 x 64 has 49,152"
    parser.add_argument("--allowed", type=float, default=4096, help=allowed)
    options = parser.parse_args()
    # Each thread would have freed memory of its own, tens of MB more or less by chance.
    glibc("mallopt", M_ARENA_MAX, 1)
    torch.manual_seed(0)
    work, unit = (train, "step") if options.scenes is None else (open_scenes, "scene")
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr):
        samples, about = work(options, Path(folder))
    cuda = options.device == "cuda"
    result: dict[str, Any] = {**about, "device": torch.cuda.get_device_name(0) if cuda else "cpu"}
    names = ["host", *(["cuda_allocated", "cuda_reserved"] if cuda else []), *(["traced"] if unit == "scene" else [])]
    places, *series = np.array(samples, dtype=float).T
    slopes = {}
    for name, values in zip(names, series, strict=True):
        slopes[name] = float(np.polyfit(places, values, 1)[0])
        result |= {
            f"{name}_mb_first": round(values[0] / 1e6, 2),
            f"{name}_mb_last": round(values[-1] / 1e6, 2),
            f"{name}_bytes_a_{unit}": round(slopes[name], 1),
        }
    print(json.dumps(result))
    sys.exit(int(max(slopes.values()) > options.allowed))


if __name__ == "__main__":
    main()
