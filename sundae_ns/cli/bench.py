"""``sundae bench frame``: milliseconds of splat, head and whole frame, with the error of the timed frames."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sundae_ns.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from sundae_ns.evaluation import Measured
    from sundae_ns.scenes.models import Opened


def bench(
    measurement: Annotated[Literal["frame"], tyro.conf.Positional],
    scene: Annotated[Path, tyro.conf.Positional],
    factors: tuple[float, ...] = (1.0,),
    precisions: tuple[Literal["fp32", "bf16"], ...] = (),
    views: int | None = None,
    repeats: int = 5,
    data: Path | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Time the frames of a finished scene: splat, head and whole frame, with the error of the timed frames.

    The folder benchmarks/ of the repository has other measurements.

    Args:
        measurement: frame.
        scene: a run (its folder or config.yml), or a packed scene.
        factors: on the sides of the images; the test images are resized alike.
        precisions: arithmetic of the head; by default both on CUDA, and fp32 on a CPU, the only one there.
        views: number of test views to measure on, from the first; by default all.
        repeats: timed runs of each view; their median counts.
        data: folder of the capture, if it moved; a packed scene needs it.
        as_json: print one line of JSON for each size and precision, instead of a table.
    """
    if repeats < 1 or (views is not None and views < 1):
        raise ConfigError(f"{repeats} timed runs of {views} views measure nothing: use at least 1 of each")
    from contextlib import redirect_stdout
    from dataclasses import replace
    from io import StringIO

    import torch
    from rich.console import Console
    from rich.progress import Progress

    from sundae_ns.evaluation import without_nan
    from sundae_ns.scenes.measure import measure_scene, rendered_as
    from sundae_ns.scenes.models import load_model

    console = Console(stderr=True)
    with console.status("Opening the run"), redirect_stdout(StringIO()):  # nerfstudio prints while it loads
        run = load_model(scene, data=data)
    run = replace(run, cameras=run.cameras[:views], truths=run.truths[:views])
    on_gpu, has_head = run.model.device.type == "cuda", run.model.head is not None
    device = torch.cuda.get_device_name() if on_gpu else "cpu"
    every = ("fp32", "bf16") if on_gpu and has_head else (None,)
    jobs = [(factor, precision) for factor in factors for precision in precisions or every]
    found: list[dict[str, Any]] = []
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("Timing frames", total=len(jobs) * len(run.cameras))
        for factor, precision in jobs:
            line = {"config": str(scene), "device": device, "primitives": run.model.num_points, "factor": factor}
            with rendered_as(run, factor=factor, precision=precision) as shown:
                measured = measure_scene(
                    shown, label="", repeats=repeats, visible=False, progress=lambda: progress.advance(task)
                )
                line |= {"repeats": repeats, **_figures(shown, measured)}
            found.append(line)
            if as_json:
                rounded = {k: round(v, 4) if isinstance(v, float) else v for k, v in line.items()}
                print(json.dumps(without_nan(rounded), allow_nan=False), flush=True)
    if not as_json:
        title = f"{run.model.num_points:,} primitives, {device}, {len(run.cameras)} test views"
        Console().print(_table(found, title))
    return 0


def _figures(run: Opened, measured: Measured) -> dict[str, Any]:
    """Speed of a configuration beside its error: means over the test views."""
    head, full, base = run.model.head, measured.full, measured.base
    return {
        "width": int(run.cameras[0].width),
        "height": int(run.cameras[0].height),
        "precision": "fp32" if head is None else head.config.precision,
        "views": len(run.cameras),
        "fingerprint": run.fingerprint,
        **{"ms_frame": full.ms, "ms_splat": base.ms, "ms_head": measured.ms_head},
        # Images smaller than its window have no SSIM.
        **{metric: full.mean(metric) for metric in ("psnr", "ssim")},
        **{f"{metric}_base": base.mean(metric) for metric in ("psnr", "ssim")},
    }


def _table(lines: Sequence[Mapping[str, Any]], title: str) -> Table:
    from rich.table import Table

    from sundae_ns.evaluation.document import number

    table = Table(title=title, caption="frame, splat and head in ms; off: without the head")
    for column in ("size", "head in", "frame", "splat", "head", "PSNR", "SSIM", "PSNR off", "SSIM off"):
        table.add_column(column, justify="right", no_wrap=True)
    digits = {"ms_frame": 2, "ms_splat": 2, "ms_head": 2, "psnr": 2, "ssim": 4, "psnr_base": 2, "ssim_base": 4}
    for line in lines:
        figures = (number(line[name], places) for name, places in digits.items())
        table.add_row(f"{line['width']}x{line['height']}", line["precision"], *figures)
    return table
