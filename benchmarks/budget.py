"""Let the budget find itself on the embedded scene and on a plain wall, at the same allowed drop; one JSON of both.

    python benchmarks/budget.py --out benchmarks/results/budget.json
    python benchmarks/budget.py --kinds wall --seeds 0 1 2 --steps 1500
    python benchmarks/budget.py --data CAPTURE --steps 30000     # a capture, with the method's own options

Needs no GPU: pictures are small. The wall is the test that a scene gets only what it needs.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils import profiler, writer

from sundae_ns.data import write_scene
from sundae_ns.measure import sizes
from sundae_ns.method_configs import sundae_auto, sundae_tiny

TINY = ("num_downscales", "warmup_length", "stop_screen_size_at", "reset_alpha_every")
TINY += ("densify_grad_thresh", "cull_alpha_thresh")


def small_config(steps: int) -> Any:
    """``sundae-auto`` for small pictures: warm-up, search and fine-tuning in the method's own proportions."""
    config, tiny = deepcopy(sundae_auto.config), sundae_tiny.config
    config.max_num_iterations = steps
    config.vis = "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.steps_per_save = config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
    model = config.pipeline.model
    for name in TINY:
        setattr(model, name, getattr(tiny.pipeline.model, name))
    model.pruning.prune_at = model.stop_split_at = steps // 2
    model.pruning.stop = round(steps * 26 / 30)
    model.pruning.search_every = max(round(steps / 80), 1)
    model.sh_degree_interval = max(steps // 10, 1)  # all bands take part before the warm-up ends
    model.head.size, model.head.pixel_unshuffle, model.head.num_features = "tiny", 1, 5
    for group in config.optimizers.values():
        if group["scheduler"] is not None:
            group["scheduler"].max_steps = steps
    return config


def train(config: Any) -> tuple[dict[str, Any], float]:
    """Train; returns what the search wrote with the test PSNR beside it, and the seconds."""
    torch.manual_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    started = time.perf_counter()
    trainer.train()
    seconds = time.perf_counter() - started
    found = json.loads((trainer.base_dir / "budget.json").read_text())
    tested = trainer.pipeline.get_average_eval_image_metrics()
    stored = sizes(trainer.pipeline.model)
    found["test"] = {"psnr": tested["psnr"], "ssim": tested["ssim"]}
    found["stored_bytes"] = stored.total if found["head"] else stored.primitives
    found["peak"] = trainer.pipeline.model.pruning_state["peak"]
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    profiler.PROFILER.clear()
    return found, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--work", type=Path, default=Path(".budget"))
    parser.add_argument("--kinds", nargs="+", default=["still-life", "wall"])
    parser.add_argument("--data", type=Path, help="a capture instead of the made scenes")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--size", type=int, default=64, help="pixels a side")
    parser.add_argument("--views", type=int, default=32)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--sensor-noise", type=float, default=0.03)
    parser.add_argument("--max-psnr-drop", type=float)
    parser.add_argument("--max-bytes", type=int)
    parser.add_argument("--max-primitives", type=int)
    options = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    rows = []
    for kind in ["capture"] if options.data else options.kinds:
        for seed in options.seeds:
            if options.data:
                scene, config = options.data, deepcopy(sundae_auto.config)
                config.max_num_iterations, config.vis = options.steps, "tensorboard"
                config.viewer.quit_on_train_completion = True
            else:
                scene = write_scene(
                    options.work / f"{kind}-{seed}",
                    kind=kind,
                    seed=seed,
                    train_views=options.views,
                    test_views=6,
                    width=options.size,
                    height=options.size,
                    points=options.points,
                    sensor_noise=options.sensor_noise,
                )
                config = small_config(options.steps)
            config.machine.seed = 42 + seed
            config.data = config.pipeline.datamanager.data = scene
            config.output_dir = options.work / "runs"
            config.experiment_name, config.timestamp = f"{kind}-{seed}", str(options.steps)
            for name in ("max_psnr_drop", "max_bytes", "max_primitives"):
                setattr(config.pipeline.model.pruning, name, getattr(options, name))
            found, seconds = train(config)
            rows.append({"kind": kind, "seed": seed, "seconds": seconds, **found})
            last = found["curve"][-1]
            cost = found["cost"]
            print(
                f"{kind} seed {seed}: {found['before']} -> {found['primitives']} primitives, degree {found['degree']}, "
                f"head {found['head']}, {last['bytes']} bytes, {found['reference'] - last['psnr']:+.3f} dB "
                f"({last['verdict']}); {cost['share_of_steps']:.1%} of the steps lost, {cost['seconds']:.0f} s of "
                f"{seconds:.0f} s for looking and cutting"
            )
    if options.out:
        content = {
            "command": " ".join(["python benchmarks/budget.py", *[str(word) for word in sys.argv[1:]]]),
            "commit": commit.stdout.strip(),
            "machine": f"{platform.machine()}, {torch.get_num_threads()} threads"
            if not torch.cuda.is_available()
            else torch.cuda.get_device_name(0),
            "rows": rows,
        }
        options.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
