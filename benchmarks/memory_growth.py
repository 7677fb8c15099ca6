"""Train far past the prune and watch memory, of the host and of a GPU if there is one; print one JSON line.

    python benchmarks/memory_growth.py --steps 2000

Exits with 1 if the host's resident memory or the GPU's allocated memory grows by more than ``--allowed`` bytes a step.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import tempfile
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sundae_ns.data import write_scene
from sundae_ns.method_configs import sundae_tiny

PRUNE_AT, SETTLE, EVERY = 60, 200, 50


def resident() -> int:
    """Bytes of this process in the host's memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=2000, help="steps past the prune")
    parser.add_argument("--allowed", type=float, default=4096, help="bytes a step; a picture is 49,152")
    options = parser.parse_args()
    torch.manual_seed(0)
    samples: list[tuple[int, int, int]] = []
    with tempfile.TemporaryDirectory() as folder:
        scene = write_scene(
            Path(folder) / "scene", train_views=8, test_views=2, width=64, height=64, points=300, samples=1
        )
        config: Any = deepcopy(sundae_tiny.config)
        config.data = config.pipeline.datamanager.data = scene
        config.output_dir, config.timestamp = Path(folder) / "out", "now"
        config.viewer.quit_on_train_completion = True
        config.max_num_iterations = PRUNE_AT + options.steps + 1
        config.steps_per_save = 500
        config.pipeline.model.pruning.prune_at = PRUNE_AT
        config.pipeline.model.warmup_length = 5
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        iterate = trainer.train_iteration

        def watched(step: int) -> Any:
            if step >= PRUNE_AT + SETTLE and step % EVERY == 0:
                gc.collect()
                cuda = torch.cuda.memory_allocated() if torch.cuda.is_available() else 0
                samples.append((step, resident(), cuda))
            return iterate(step)

        trainer.train_iteration = watched
        trainer.train()
        primitives = trainer.pipeline.model.num_points

    steps, host, cuda = np.array(samples, dtype=float).T
    slopes = {"host": np.polyfit(steps, host, 1)[0], "cuda": np.polyfit(steps, cuda, 1)[0]}
    result = {
        "steps_past_the_prune": options.steps,
        "primitives": primitives,
        "device": torch.cuda.get_device_name(0) if torch.cuda.is_available() else "cpu",
        "host_mb_first": round(host[0] / 1e6, 2),
        "host_mb_last": round(host[-1] / 1e6, 2),
        "host_bytes_a_step": round(float(slopes["host"]), 1),
        "cuda_bytes_a_step": round(float(slopes["cuda"]), 1) if torch.cuda.is_available() else None,
    }
    print(json.dumps(result))
    sys.exit(int(max(slopes.values()) > options.allowed))


if __name__ == "__main__":
    main()
