"""``sundae demo``: train and evaluate the shipped capture with nerfstudio's commands."""

from __future__ import annotations

import json
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.progress import Progress

from sundae_ns.cli.process import console_script, percent_of, run_logged
from sundae_ns.data import write_demo_capture
from sundae_ns.errors import ConfigError, writing
from sundae_ns.evaluation import ComparisonRow, comparison_sheet, report_text

METHOD = "sundae-tiny"
SHOWN = 3
"""Number of test views in the comparison image."""
BACKGROUND = "white"
"""Colour where no training view looks, above all beside the sky; a dark one shows as stains."""


def _read_image(path: Path) -> torch.Tensor:
    """Pixels ``[H, W, 3]``, float32 in [0, 1]."""
    with Image.open(path) as image:
        return torch.from_numpy(np.asarray(image.convert("RGB"), dtype=np.float32) / 255)


def _comparison(renders: Path, out: Path) -> None:
    """Write the comparison image of a few test views from the images that ``ns-eval`` wrote."""
    pairs = sorted(renders.glob("eval_img_*.png"))
    rows = []
    for path in pairs[:: max(len(pairs) // SHOWN, 1)][:SHOWN]:
        truth, compensated = _read_image(path).chunk(2, dim=1)
        base = _read_image(path.with_name(path.name.replace("img", "base")))
        rows.append(ComparisonRow(truth, base, compensated, title=f"test view {int(path.stem[-4:])}"))
    comparison_sheet(rows).save(out)


def run_demo(out: Path, steps: int | None = None, console: Console | None = None) -> int:
    """Write the capture, train, evaluate, and print the results.

    Args:
        out: folder for scene, run, logs, images and web page; an earlier demo in it is replaced.
        steps: number of training steps, to which the schedule is scaled; None takes the method's default.
        console: where to print.

    Raises:
        ConfigError: there is no step.
        SundaeError: a command failed; the message ends with the last lines of its output.
    """
    if steps is not None and steps < 1:
        raise ConfigError(f"steps is {steps}; give at least 1")
    console = console or Console()
    scene, run = out / "scene", out / "runs" / "demo" / METHOD / "run"
    device = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "CPU"
    console.print(f"SUNDAE demo on {device}: train a small scene with ns-train, evaluate it with ns-eval.")
    with writing(f"cannot write to {out}"):
        write_demo_capture(scene)
    with Progress(console=console, transient=True) as progress:
        training = progress.add_task(f"ns-train {METHOD}", total=100)

        def show(line: str) -> None:
            percent = percent_of(line)
            if percent is not None:
                progress.update(training, completed=percent)

        train = [console_script("ns-train"), METHOD, "--data", str(scene), "--output-dir", str(out / "runs")]
        train += ["--experiment-name", "demo", "--timestamp", "run"]
        train += ["--pipeline.model.background-color", BACKGROUND]
        if steps is not None:
            train += ["--max-num-iterations", str(steps)]
        # Remove the record of an earlier demo.
        (run / "prune.json").unlink(missing_ok=True)
        run_logged(train, out / "train.log", show)
        progress.update(training, completed=100)
        progress.add_task("ns-eval", total=None)
        evaluate = [console_script("ns-eval"), "--load-config", str(run / "config.yml")]
        evaluate += ["--output-path", str(out / "eval.json"), "--render-output-path", str(out / "renders")]
        run_logged(evaluate, out / "eval.log")
        progress.add_task("Timing frames", total=None)

        # nerfstudio prints messages while it imports and loads.
        with open(out / "measure.log", "w") as log, redirect_stdout(log), redirect_stderr(log):
            from sundae_ns.api.page import write_page
            from sundae_ns.scenes.measure import frame_times, sizes
            from sundae_ns.scenes.opening import load_run
            from sundae_ns.scenes.packed import packed_run
            from sundae_ns.storage.atomic import replacing

            opened = load_run(run / "config.yml")
            model, cameras = opened.model, opened.cameras
            times, stored = frame_times(model, cameras, warmup=1, repeats=3), sizes(model)
            finished, packed = packed_run(run)
            with replacing(out / "scene.sundae") as partial:
                partial.write_bytes(packed)
            write_page(out / "scene.html", finished, packed, title="sundae demo")
    _comparison(out / "renders", out / "comparison.png")

    results = json.loads((out / "eval.json").read_text())["results"]
    prunes = json.loads((run / "prune.json").read_text()) if (run / "prune.json").exists() else []
    prune = prunes[-1] if prunes else {"before": model.num_points, "after": model.num_points}
    base = {name.removesuffix("_base"): value for name, value in results.items() if name.endswith("_base")}
    stages = (
        ("warm-up", prune["before"], prune.get("warm_up")),
        ("after the prune", prune["after"], prune.get("pruned")),
        ("final, base colours", prune["after"], base),
        ("final, compensated", prune["after"], results),
    )
    title = f"sundae demo, {cameras[0].width.item()} x {cameras[0].height.item()} px, {device}"
    sizes_of_parts = (stored.primitives, stored.head)
    text = report_text(title, stages, sizes_of_parts, (times.splat, times.head, times.frame))
    console.print(text, highlight=False)
    console.print(f"Images: {out / 'comparison.png'}   In a browser: {out / 'scene.html'}")
    console.print(f"View: ns-viewer --load-config {run / 'config.yml'}")
    return 0
