"""Train far past the prune and watch memory, of the host and of a GPU; print one JSON line.

    python benchmarks/memory_growth.py                                            # 2,000 steps on a CPU
    python benchmarks/memory_growth.py --device cuda --size 256 --points 20000    # with gsplat

Samples every 50 steps, from 200 past the prune; growth is the slope of the line through the samples. Exits with 1 if
the host's resident memory, or torch's allocated or reserved memory on the GPU, grows by more than ``--allowed`` bytes a
step.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import tempfile
from contextlib import redirect_stdout
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ray_tracing import write_still_life

from sundae_ns.method_configs import sundae_tiny

PRUNE_AT, SETTLE, EVERY = 60, 200, 50


def resident() -> int:
    """Resident memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--steps", type=int, default=2000, help="steps past the prune")
    parser.add_argument("--size", type=int, default=64, help="side of an image, pixels")
    parser.add_argument("--points", type=int, default=300, help="of the sparse cloud")
    parser.add_argument("--allowed", type=float, default=4096, help="bytes a step; an image of 64 x 64 is 49,152")
    options = parser.parse_args()
    torch.manual_seed(0)
    cuda = options.device == "cuda"
    samples: list[tuple[int, ...]] = []
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr):
        trainer = configured(options, Path(folder)).setup(local_rank=0, world_size=1)
        trainer.setup()
        iterate = trainer.train_iteration

        def watched(step: int) -> Any:
            if step >= PRUNE_AT + SETTLE and step % EVERY == 0:
                gc.collect()
                gpu = (torch.cuda.memory_allocated(), torch.cuda.memory_reserved()) if cuda else ()
                samples.append((step, resident(), *gpu))
            return iterate(step)

        trainer.train_iteration = watched
        trainer.train()
        model = trainer.pipeline.model

    steps, *series = np.array(samples, dtype=float).T
    slopes = {}
    result: dict[str, Any] = {
        "steps_past_the_prune": options.steps,
        "image": f"{options.size}x{options.size}",
        "primitives": model.num_points,
        "rasterizer": model.backend.name,
        "device": torch.cuda.get_device_name(0) if cuda else "cpu",
    }
    for name, values in zip(("host", "cuda_allocated", "cuda_reserved"), series):
        slopes[name] = float(np.polyfit(steps, values, 1)[0])
        result |= {
            f"{name}_mb_first": round(values[0] / 1e6, 2),
            f"{name}_mb_last": round(values[-1] / 1e6, 2),
            f"{name}_bytes_a_step": round(slopes[name], 1),
        }
    print(json.dumps(result))
    sys.exit(int(max(slopes.values()) > options.allowed))


if __name__ == "__main__":
    main()
