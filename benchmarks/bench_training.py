"""Time whole trainings, alone on one GPU, with the error of what was trained; print one JSON line for each.

    python benchmarks/bench_training.py CAPTURE --arms splatfacto sundae -o benchmarks/results/training_time.jsonl
    python benchmarks/bench_training.py CAPTURE --arms sundae --steps 3000

Every arm trains in a process of its own, on images of full size on the GPU, with every 8th image for the test and the
head as the method decides. Nothing is evaluated or saved while the clock runs; the clock waits for the GPU.
``curve`` lists seconds, PSNR and SSIM of the test views on the way, measured with the clock stopped.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

from harness.job import configure, trainer_of
from harness.plan import Job, parser_of
from sundae_ns.core.metrics import psnr, ssim
from sundae_ns.core.timing import now

ARMS = ("splatfacto", "sundae", "sundae-fast")


def trainer_of_arm(options: argparse.Namespace, arm: str, steps: int, out: str) -> Any:
    """A trainer that is set up."""
    words = ["--viewer.quit-on-train-completion", "True", "--pipeline.datamanager.cache-images", "gpu"]
    if arm != "splatfacto":
        words += ["--pipeline.model.evaluate-prune", "False"]
    parser, capture = parser_of(options.capture), options.capture
    job = Job(arm, "whole", capture.name, arm, str(capture), arm, steps, options.seed)
    job = replace(job, options=(*words, *options.option), parser=parser)
    return trainer_of(configure(job, Path(out))[0])[0]


def quality(trainer: Any) -> tuple[float, float]:
    """Mean PSNR and SSIM of the test views, of stock models too."""
    model, figures = trainer.pipeline.model, []
    model.eval()
    with torch.no_grad():
        for camera, batch in trainer.pipeline.datamanager.fixed_indices_eval_dataloader:
            outputs = model.get_outputs_for_camera(camera.to(model.device))
            truth = model.composite_with_background(model.get_gt_img(batch["image"]), outputs["background"])
            figures.append([float(psnr(outputs["rgb"], truth)), float(ssim(outputs["rgb"], truth))])
    model.train()
    return tuple(torch.tensor(figures).mean(dim=0).tolist())


def timed(options: argparse.Namespace, arm: str, steps: int, out: str) -> dict[str, Any]:
    """Train with the clock running; the figures of the row."""
    sys.stdout = sys.stderr  # for what nerfstudio prints in this process
    trainer = trainer_of_arm(options, arm, steps, out)
    curve: list[list[float]] = []
    spent = 0.0

    def look(step: int) -> None:
        nonlocal spent
        if step + 1 not in options.curve:
            return
        stopped = now("cuda")
        curve.append([round(stopped - started - spent, 2), *(round(value, 4) for value in quality(trainer))])
        spent += now("cuda") - stopped

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], look))
    torch.cuda.reset_peak_memory_stats()
    started = now("cuda")
    trainer.train()
    seconds = now("cuda") - started - spent
    peak = torch.cuda.max_memory_allocated() / 2**20
    decibels, similarity = quality(trainer)
    return {
        "train_s": round(seconds, 2),
        "psnr": round(decibels, 3),
        "ssim": round(similarity, 4),
        "primitives": int(trainer.pipeline.model.num_points),
        "head": getattr(trainer.pipeline.model, "head", None) is not None,
        "peak_mib": round(peak),
        "curve": curve,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, help="folder with images and sparse/0")
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=["splatfacto", "sundae"])
    parser.add_argument("--steps", type=int, help="by default those of each method")
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--curve", type=int, nargs="*", default=[], help="steps after which test views are measured")
    parser.add_argument("--option", action="append", default=[], help="a further word of ns-train")
    parser.add_argument("-o", "--output", type=Path, help="file to append the lines to")
    options = parser.parse_args()
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    for arm in options.arms:
        steps = options.steps or dict[str, Any](all_methods)[arm].max_num_iterations
        with TemporaryDirectory() as out, ProcessPoolExecutor(1, get_context("spawn")) as alone:
            measured = alone.submit(timed, options, arm, steps, out).result()
        row = {"arm": arm, "scene": options.capture.name, "steps": steps, "seed": options.seed}
        row |= {**measured, "gpu": torch.cuda.get_device_name(0), "commit": commit or None}
        print(json.dumps(row), flush=True)
        if options.output is not None:
            with options.output.open("a") as file:
                file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
