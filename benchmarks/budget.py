"""Every figure of docs/budget.md: made scenes anywhere, captures on a GPU.

    python benchmarks/budget.py --seeds 0 1 2 3 --out benchmarks/results/budget.json     # a plain wall, and the still life
    python benchmarks/budget.py --scene bonsai --data DIR                              # rows in results/runs.csv, and a table
    python benchmarks/budget.py --scene bonsai --data DIR --only continuous psnr       # some of them
    python benchmarks/budget.py --scene bonsai --data DIR --dry-run                    # the commands alone

Made scenes: ``sundae-auto`` with the same allowed drop on both kinds. The wall is the test that a scene gets only what it
needs. Pictures are small, a CPU will do.

A capture: first ``sundae`` as it is; its row, taken from the file where there is one, sets the count, the bytes and the size
of the warm-up that the other runs are held to. Every run is one of ``benchmarks/run.py``, and what the file has already is
not run again. The table has the peak of primitives and of memory.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import run
import torch
from nerfstudio.utils import profiler, writer

from sundae_ns.data import write_scene
from sundae_ns.evaluation import RunRow, read_rows
from sundae_ns.method_configs import sundae_auto, sundae_tiny
from sundae_ns.scenes.measure import sizes

TINY = (
    "num_downscales warmup_length stop_screen_size_at reset_alpha_every densify_grad_thresh cull_alpha_thresh".split()
)
PREFIX, REFERENCE = "budget-", "budget-reference"
# Pictures wait in host memory: in the GPU's they would be a good part of a peak that is to tell of training.
COMMON = ["--pipeline.datamanager.cache-images", "cpu"]


# ---------------------------------------------------------------------------------------------------------- made scenes


def small_config(steps: int) -> Any:
    """``sundae-auto`` for small pictures: warm-up, search and fine-tuning in the method's own proportions."""
    config, tiny = deepcopy(sundae_auto.config), sundae_tiny.config
    config.max_num_iterations = steps
    config.vis = "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.steps_per_save = config.steps_per_eval_image = config.steps_per_eval_all_images = run.NEVER
    model = config.pipeline.model
    for name in TINY:
        setattr(model, name, getattr(tiny.pipeline.model, name))
    model.pruning.prune_at = model.stop_split_at = steps // 2
    model.pruning.stop = round(steps * model.pruning.stop / sundae_auto.config.max_num_iterations)
    model.pruning.search_every = max(round(steps / 80), 1)
    model.sh_degree_interval = max(steps // 10, 1)  # all bands take part before the warm-up ends
    model.head.size, model.head.pixel_unshuffle, model.head.num_features = "tiny", 1, 5
    for group in config.optimizers.values():
        if group["scheduler"] is not None:
            group["scheduler"].max_steps = steps
    return config


def train(config: Any) -> dict[str, Any]:
    """Train; returns what the search wrote, with the test PSNR, the bytes and the seconds beside it."""
    run._set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    started = time.perf_counter()
    trainer.train()
    seconds = time.perf_counter() - started
    trainer.pipeline.eval()
    model = trainer.pipeline.model
    found = json.loads((trainer.base_dir / "budget.json").read_text())
    found["test"] = run.evaluate(trainer.pipeline)
    found["stored_bytes"], found["peak"], found["train_s"] = sizes(model).total, model.pruning_state["peak"], seconds
    # nerfstudio keeps its loggers in globals.
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    profiler.PROFILER.clear()
    return found


def made_scenes(options: argparse.Namespace) -> None:
    """Train on each kind and seed; print a line each, and write all of them to ``--out``."""
    found_rows = []
    for kind in options.kinds:
        for seed in options.seeds:
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
            config.pipeline.model.pruning.max_psnr_drop = options.max_psnr_drop
            found = train(config)
            found_rows.append({"kind": kind, "seed": seed, **found})
            last, cost = found["curve"][-1], found["cost"]
            print(
                f"{kind} seed {seed}: {found['before']} -> {found['primitives']} primitives, degree {found['degree']}, "
                f"head {found['head']}, {last['bytes']} bytes, {found['reference'] - last['psnr']:+.3f} dB "
                f"({last['verdict']}); {cost['share_of_steps']:.1%} of the steps lost, {cost['seconds']:.0f} s of "
                f"{found['train_s']:.0f} s for looking and cutting",
                flush=True,
            )
    if options.out:
        cuda = torch.cuda.is_available()
        content = {
            "command": shlex.join(["python", "benchmarks/budget.py", *sys.argv[1:]]),
            "commit": run.commit(),
            "machine": torch.cuda.get_device_name(0)
            if cuda
            else f"{torch.get_num_threads()} of {os.cpu_count()} cores",
            "rows": found_rows,
        }
        options.out.write_text(json.dumps(content, indent=1) + "\n")


# ------------------------------------------------------------------------------------------------------------- captures


def held_to(reference: RunRow | None) -> dict[str, tuple[str, dict[str, object]]]:
    """Method and options of the model by variant; figures to hold them to are the reference's, or an example's."""
    kept, share, stored = 50_000, 0.1, 16_000_000
    if reference is not None:
        kept, share, stored = reference.primitives, reference.keep_ratio or 1.0, reference.bytes_total
    grown = round(kept / share)
    cap = {"pruning.max-primitives": 3 * grown // 10, "pruning.target-primitives": kept}
    return {
        "budget-psnr": ("sundae-auto", {"pruning.max-psnr-drop": 0.1}),
        "budget-primitives": ("sundae-auto", {"pruning.max-primitives": kept}),
        "budget-bytes": ("sundae-auto", {"pruning.max-bytes": stored}),
        # The same share of the same count, and so the same number in the end.
        "budget-mcmc": ("sundae", {"warmup": "mcmc", "mcmc-cap": grown}),
        "budget-continuous": ("sundae-continuous", cap),
        "budget-continuous-mcmc": ("sundae-continuous", {"warmup": "mcmc", **cap}),
    }


def capture(options: argparse.Namespace) -> None:
    """Run what the file lacks, then print this scene's rows."""

    def rows() -> dict[str, RunRow]:
        known = read_rows(options.results) if options.results.exists() else []
        return {r.variant: r for r in known if r.scene == options.scene and r.variant.startswith(PREFIX)}

    def go(variant: str, method: str, extra: dict[str, object]) -> None:
        command = [sys.executable, str(Path(__file__).with_name("run.py")), method, "--scene", options.scene]
        command += ["--data", str(options.data), "--variant", variant, "--results", str(options.results), "--", *COMMON]
        command += [word for name, value in extra.items() for word in (f"--pipeline.model.{name}", str(value))]
        print("+", shlex.join(command), flush=True)
        if not options.dry_run:
            subprocess.run(command, check=True)

    if REFERENCE not in rows():
        go(REFERENCE, "sundae", {})
    for variant, (method, extra) in held_to(rows().get(REFERENCE)).items():
        wanted = options.only is None or any(word in variant for word in options.only)
        if wanted and variant not in rows():
            go(variant, method, extra)
    print("\n| variant | primitives | PSNR | PSNR, head off | MB | peak primitives | peak MiB | train s |")
    print("|---|---|---|---|---|---|---|---|")
    for variant, row in rows().items():
        print(
            f"| {variant[len(PREFIX) :]} | {row.primitives:,} | {row.psnr:.2f} | {row.psnr_base:.2f} "
            f"| {row.bytes_total / 1e6:.1f} | {row.peak_primitives:,} | {row.peak_vram_mib:,.0f} | {row.train_s:.0f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", help="name of a capture; without it, scenes are made")
    parser.add_argument("--data", type=Path, help="folder of the capture")
    parser.add_argument("--only", nargs="+", help="of a capture: variants with one of these words in their name")
    parser.add_argument("--results", type=Path, default=run.RESULTS)
    parser.add_argument("--dry-run", action="store_true")
    parser.add_argument("--out", type=Path, help="file for the figures of made scenes")
    parser.add_argument("--work", type=Path, default=Path("outputs/budget"))
    parser.add_argument("--kinds", nargs="+", default=["still-life", "wall"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--size", type=int, default=64, help="pixels a side")
    parser.add_argument("--views", type=int, default=96)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--sensor-noise", type=float, default=0.03)
    parser.add_argument("--max-psnr-drop", type=float)
    options = parser.parse_args()
    if options.scene is None:
        made_scenes(options)
    elif options.data is None:
        parser.error("--scene needs --data, the folder of the capture")
    else:
        capture(options)


if __name__ == "__main__":
    main()
