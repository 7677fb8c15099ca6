"""``sundae bench flicker``: flicker of compensated images over that of base colours, along camera paths."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict
from io import StringIO
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from sundae_ns.evaluation import without_nan
from sundae_ns.scenes.flicker import FRAMES, FlickerFigures, measure_flicker
from sundae_ns.scenes.measure import rendered_as
from sundae_ns.scenes.opening import load_run


def run_flicker(load_config: Path, *, places: int, phases: Sequence[int], json: bool) -> int:
    """Measure and print; options are those of the command.

    Raises:
        CheckpointError: the run cannot be opened.
        ConfigError: the run has no head, or an option cannot work.
        DataError: the capture is missing or has too few views.
    """
    console = Console(stderr=True)
    with console.status("Opening the run"), redirect_stdout(StringIO()):  # nerfstudio prints while it loads
        run = load_run(load_config)
        _ = run.datamanager.cached_train  # loads the training images, whose undistortion changes their cameras
    found: list[tuple[int, FlickerFigures]] = []
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("Rendering paths", total=places * FRAMES * max(len(phases), 1))
        for count in phases or (None,):
            with rendered_as(run, phases=count) as shown:
                figures = measure_flicker(shown, places=places, progress=lambda: progress.advance(task))
                assert shown.model.head is not None
                found += [(shown.model.head.config.phases, one) for one in figures]
    if json:
        device = torch.cuda.get_device_name() if run.model.device.type == "cuda" else "cpu"
        where = {"config": str(load_config), "scene": run.scene, "device": device, "fingerprint": run.fingerprint}
        for runs, one in found:
            line = {**where, "places": places, "phases": runs, **asdict(one), "ratio": one.ratio}
            print(jsonlib.dumps(without_nan(line), allow_nan=False))
        return 0
    table = Table(
        title=f"{run.model.num_points:,} primitives, {places} paths of {FRAMES} frames",
        caption="squared errors of warped frames x 1e6; flicker: without the least of both at each pixel",
    )
    for column in ("runs", "frames apart", "head", "base", "flicker: head", "base", "head / base"):
        table.add_column(column, justify="right", no_wrap=True)
    for runs, one in found:
        errors = (one.mse, one.mse_base, one.excess, one.excess_base)
        cells = (str(runs), str(one.frames_apart), *(f"{1e6 * error:,.1f}" for error in errors), f"{one.ratio:.2f}")
        table.add_row(*cells)
    Console().print(table)
    return 0
