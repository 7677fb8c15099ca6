"""``sundae demo``: train the shipped capture with nerfstudio's command, and evaluate it."""

from __future__ import annotations

import json
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Annotated

import tyro

from sundae_ns.cli.outputs import Overwrite, check_folder
from sundae_ns.cli.process import loading, percent_of, quoted, run_logged, word
from sundae_ns.errors import ConfigError, writing

METHOD = "sundae-tiny"
SHOWN = 3
"""Number of test views in the comparison image."""
BACKGROUND = "white"
"""Colour where no training view looks, above all beside the sky; a dark one shows as stains."""


def demo(
    out: Annotated[Path, tyro.conf.Positional] = Path(".demo"),
    steps: int | None = None,
    overwrite: Overwrite = False,
) -> int:
    """Write the embedded capture, train it with ns-train, evaluate it, and print the results.

    Args:
        out: folder for the capture, the run and the images.
        steps: number of training steps; by default that of sundae-tiny.
        overwrite: replace an earlier demo in the folder.
    """
    check_folder(out, reads=[], overwrite=overwrite)
    if steps is not None and steps < 1:
        raise ConfigError(f"steps is {steps}; give at least 1")
    with loading():
        import torch
        from rich.console import Console
        from rich.progress import Progress

        from sundae_ns.data import write_demo_capture
        from sundae_ns.evaluation import comparison_sheet, report_text

    console = Console()
    scene, run = out / "scene", out / "runs" / "demo" / METHOD / "run"
    device = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "CPU"
    console.print(f"SUNDAE demo on {device}: train a small scene with ns-train, and evaluate it.")
    with writing(f"cannot write to {out}"):
        write_demo_capture(scene)
    with Progress(console=console, transient=True) as progress:
        training = progress.add_task(f"ns-train {METHOD}", total=100)

        def show(line: str) -> None:
            percent = percent_of(line)
            if percent is not None:
                progress.update(training, completed=percent)

        train = ["ns-train", METHOD, "--data", word(scene), "--output-dir", word(out / "runs")]
        train += ["--experiment-name", "demo", "--timestamp", "run"]
        train += ["--pipeline.model.background-color", BACKGROUND]
        if steps is not None:
            train += ["--max-num-iterations", str(steps)]
        # Remove the record of an earlier demo.
        (run / "prune.json").unlink(missing_ok=True)
        run_logged(train, out / "train.log", show)
        progress.update(training, completed=100)
        progress.add_task("Evaluating", total=None)

        # nerfstudio prints messages while it imports and loads.
        with open(out / "measure.log", "w", encoding="utf-8") as log, redirect_stdout(log), redirect_stderr(log):
            from sundae_ns.api.packing import packed_bytes
            from sundae_ns.api.page import write_page
            from sundae_ns.scenes.measure import comparison_of, evaluation, frame_times, sizes
            from sundae_ns.scenes.models import load_model, load_run
            from sundae_ns.storage.atomic import write_bytes, write_image, write_text
            from sundae_ns.storage.run_folder import prunes_of

            evaluated = evaluation(run)
            write_text(out / "eval.json", json.dumps(evaluated, indent=2, allow_nan=False) + "\n")
            opened = load_model(run / "config.yml")
            model, cameras = opened.model, opened.cameras
            times, stored = frame_times(model, cameras, warmup=1, repeats=3), sizes(model)
            chosen = range(0, len(cameras), max(len(cameras) // SHOWN, 1))[:SHOWN]
            rows = [comparison_of(model, cameras[i], opened.truths[i], f"test view {i}") for i in chosen]
            write_image(out / "comparison.png", comparison_sheet(rows))
            finished = load_run(run)
            packed = packed_bytes(finished)
            write_bytes(out / "scene.sundae", packed)
            write_page(out / "scene.html", finished, packed, title="sundae demo")

    results, prunes = evaluated["results"], prunes_of(run)
    prune = prunes[-1] if prunes else {"before": model.num_points, "after": model.num_points}
    base = {name.removesuffix("_base"): value for name, value in results.items() if name.endswith("_base")}
    stages = (
        ("warm-up", prune["before"], prune.get("warm_up")),
        ("after the prune", prune["after"], prune.get("pruned")),
        ("final, base colours", prune["after"], base),
        ("final, compensated", prune["after"], results),
    )
    title = f"sundae demo, {cameras[0].width.item()} x {cameras[0].height.item()} px, {device}"
    text = report_text(title, stages, (stored.primitives, stored.head), (times.splat, times.head, times.frame))
    console.print(text, highlight=False)
    console.print(f"Images: {out / 'comparison.png'}   In a browser: {out / 'scene.html'}")
    console.print(f"View: ns-viewer --load-config {quoted(run / 'config.yml')}")
    return 0
