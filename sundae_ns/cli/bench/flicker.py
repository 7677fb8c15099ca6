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
from sundae_ns.evaluation.document import number
from sundae_ns.scenes.flicker import FRAMES, measure_flicker
from sundae_ns.scenes.opening import load_run


def run_flicker(load_config: Path, *, places: int, phases: Sequence[int], data: Path | None, json: bool) -> int:
    """Measure and print; options are those of the command.

    Raises:
        CheckpointError: the run cannot be opened.
        ConfigError: the run has no head, or an option cannot work.
        DataError: the capture is missing or has too few views.
    """
    console = Console(stderr=True)
    with console.status("Opening the run"), redirect_stdout(StringIO()):  # nerfstudio prints while it loads
        run = load_run(load_config, data=data)
        _ = run.datamanager.cached_train  # loads the training images, whose undistortion changes their cameras
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("Rendering paths", total=places * FRAMES)
        found = measure_flicker(run, places=places, phases=phases, progress=lambda: progress.advance(task))
    if json:
        device = torch.cuda.get_device_name() if run.model.device.type == "cuda" else "cpu"
        where = {"config": str(load_config), "scene": run.scene, "device": device, "fingerprint": run.fingerprint}
        for one in found:
            line = {**where, **asdict(one), "ratio": one.ratio}
            print(jsonlib.dumps(without_nan(line), allow_nan=False))
        return 0
    table = Table(
        title=f"{run.model.num_points:,} primitives, {found[0].paths} paths of {FRAMES} frames",
        caption="squared errors of warped frames x 1e6; flicker: without the least of all rows and base at each pixel",
    )
    for column in ("runs", "frames apart", "head", "base", "flicker: head", "base", "head / base"):
        table.add_column(column, justify="right", no_wrap=True)
    for one in found:
        errors = [number(1e6 * error, 1) for error in (one.mse, one.mse_base, one.excess, one.excess_base)]
        table.add_row(str(one.phases), str(one.frames_apart), *errors, number(one.ratio, 2))
    Console().print(table)
    return 0
