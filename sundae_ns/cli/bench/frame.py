"""``sundae bench frame``: milliseconds of splat, head and whole frame, with the error of the timed frames."""

from __future__ import annotations

import json as jsonlib
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, replace
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

from sundae_ns.errors import ConfigError
from sundae_ns.evaluation import without_nan
from sundae_ns.evaluation.document import number
from sundae_ns.scenes.measure import FrameFigures, frame_figures
from sundae_ns.scenes.opening import load_run


def run_frame(
    load_config: Path,
    *,
    factors: Sequence[float],
    precisions: Sequence[str],
    phases: Sequence[int],
    views: int | None,
    repeats: int,
    json: bool,
) -> int:
    """Measure and print; options are those of the command.

    Raises:
        BackendError: a precision other than fp32 on a CPU.
        CheckpointError: the run cannot be opened.
        ConfigError: an option cannot work.
        DataError: the capture is missing or has no test views.
    """
    if repeats < 1 or (views is not None and views < 1):
        raise ConfigError(f"{repeats} timed runs of {views} views measure nothing: use at least 1 of each")
    with redirect_stdout(sys.stderr):  # nerfstudio prints while it loads
        run = load_run(load_config)
    run = replace(run, cameras=run.cameras[:views], truths=run.truths[:views])
    device = torch.cuda.get_device_name() if run.model.device.type == "cuda" else "cpu"
    every = ("fp32", "bf16", "fp16") if device != "cpu" and run.model.head is not None else (None,)
    wanted: Sequence[str | None] = precisions or every
    jobs = [(factor, precision, count) for factor in factors for precision in wanted for count in phases or (None,)]
    found: list[FrameFigures] = []
    for factor, precision, count in track(jobs, description="Frames", transient=True, console=Console(stderr=True)):
        found.append(frame_figures(run, factor=factor, precision=precision, phases=count, repeats=repeats))
        if json:
            line = {"config": str(load_config), "device": device, "primitives": run.model.num_points}
            rounded = {k: round(v, 4) if isinstance(v, float) else v for k, v in asdict(found[-1]).items()}
            line |= {"factor": factor, "repeats": repeats, **rounded}
            # Images smaller than its window have no SSIM.
            print(jsonlib.dumps(without_nan(line), allow_nan=False), flush=True)
    if not json:
        Console().print(_table(found, f"{run.model.num_points:,} primitives, {device}, {len(run.cameras)} test views"))
    return 0


def _table(figures: Sequence[FrameFigures], title: str) -> Table:
    table = Table(title=title, caption="frame, splat and head in ms; off: without the head")
    for column in ("size", "head in", "runs", "frame", "splat", "head", "PSNR", "SSIM", "PSNR off", "SSIM off"):
        table.add_column(column, justify="right", no_wrap=True)
    for f in figures:
        times = (number(value, 2) for value in (f.ms_frame, f.ms_splat, f.ms_head))
        errors = (number(f.psnr, 2), number(f.ssim, 4), number(f.psnr_base, 2), number(f.ssim_base, 4))
        table.add_row(f"{f.width}x{f.height}", f.precision, str(f.phases), *times, *errors)
    return table
