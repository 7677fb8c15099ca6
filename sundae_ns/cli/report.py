"""``sundae report``: the quality, speed and size of finished runs, measured on their test views."""

from __future__ import annotations

import json
import shlex
from collections.abc import Collection
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from io import StringIO
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
import tyro
from rich.markup import escape

from sundae_ns.cli.options import Out, Overwrite, check_folder, check_least, progress_bar
from sundae_ns.core.errors import ConfigError, SundaeError
from sundae_ns.core.files import write_files
from sundae_ns.core.metrics import Lpips, Net, flip_available, lpips_weights
from sundae_ns.report.measured import Measured, csv_text, markdown
from sundae_ns.train.curve import read_count_curve

if TYPE_CHECKING:
    from sundae_ns.plugin.finished_runs import Opened
    from sundae_ns.report.report_page import ShownView


def report(
    runs: Annotated[list[Path], tyro.conf.Positional],
    out: Out,
    data: Path | None = None,
    lpips_net: Net = "alex",
    warmup: int = 3,
    repeats: int = 5,
    overwrite: Overwrite = False,
) -> int:
    """Measure quality, speed and size of finished runs on their test views; write a web page of sliders, and tables.

    Args:
        runs: runs of sundae or splatfacto (their folders or config.yml), and packed scenes; no code in them runs.
        out: folder to write.
        data: folder of the capture, if it moved; packed scenes need it, because they do not record it.
        lpips_net: net of LPIPS, which is measured if its weights are on disk; values of different nets do not compare.
        warmup: untimed renderings of each view before timing.
        repeats: timed renderings of each view; 0 measures no times.
    """
    check_folder(out, reads=[*runs, data], overwrite=overwrite)
    if not runs:
        raise ConfigError("there is nothing to report on; give the folders of finished runs")
    check_least(warmup=(warmup, 0), repeats=(repeats, 0))
    from sundae_ns.plugin.finished_runs import load_model
    from sundae_ns.report.measure import measure_scene
    from sundae_ns.report.report_page import ShownRun, cameras_for_each, report_page

    words = [*runs, "-o", out, "--lpips-net", lpips_net, "--warmup", warmup, "--repeats", repeats]
    command = shlex.join(map(str, ["sundae", "report", *words, *(["--data", data] if data else [])]))
    lpips = Lpips(lpips_net) if lpips_weights(lpips_net)[1].is_file() else None
    missing = f"LPIPS: the weights of its net ({lpips_net}) are missing; sundae doctor says where to put them."
    notes = [] if flip_available() else ["FLIP: the package is not installed; run pip install flip-evaluator."]
    notes += [missing] if lpips is None else []
    measure = partial(measure_scene, lpips=lpips, warmup=warmup, repeats=repeats, command=command)
    done, failures = list[ShownRun](), list[SundaeError]()
    with progress_bar() as progress:
        for path in runs:
            task = progress.add_task(f"Opening {escape(str(path))}", total=None)
            try:
                with redirect_stdout(StringIO()), redirect_stderr(StringIO()):  # nerfstudio's messages
                    opened = load_model(path, data=data)
                label = _label(opened, {run.measured.label for run in done})
                progress.update(task, description=f"Measuring {escape(label)}", total=len(opened.cameras))
                measured = measure(opened, label=label, progress=partial(progress.advance, task))
                progress.update(task, description=f"Encoding views of {escape(label)}")
                views = _views(opened, measured, cameras_for_each(len(runs)))
                curve = read_count_curve(opened.source) if opened.packed_bytes is None else None
                done.append(ShownRun(measured, views, curve, capture=str(opened.capture.resolve())))
            except SundaeError as error:  # keep the measurements of the other runs
                failures.append(error)
                notes.append(f"{path}: {error}")
            progress.remove_task(task)
    if not done:
        raise failures[0]
    scenes: dict[str, list[Measured]] = {}
    for run in done:
        scenes.setdefault(run.measured.scene, []).append(run.measured)
    notes += [
        f"Comparison within {scene}: its runs have different test views, so their numbers do not compare."
        for scene, measured_runs in scenes.items()
        if len({(run.resolution, len(run.full.views)) for run in measured_runs}) > 1
    ]
    rows, page = [run.measured.as_json() for run in done], report_page(done, notes, command)
    files = {"json": json.dumps(rows, indent=1), "csv": csv_text(rows), "md": markdown(scenes, notes), "html": page}
    write_files({out / f"report.{kind}": text.encode(errors="backslashreplace") for kind, text in files.items()})
    shown, total = sum(len(run.views) for run in done), sum(len(run.measured.full.views) for run in done)
    print("".join(f"Left out: {note}\n" for note in notes), end="")
    print(f"wrote {out / 'report.html'}, to look at in a browser: {len(page) / 1e6:.1f} MB, {shown} of {total} views")
    print(f"wrote {out / 'report.md'}, report.csv and report.json: its table")
    return 1 if failures else 0


def _label(opened: Opened, taken: Collection[str]) -> str:
    """A short name for a run, different from those already taken."""
    label = "/".join(dict.fromkeys(filter(None, (opened.variant, opened.method))))
    longer = f"{label}/{opened.source.name}"
    names = chain([label, longer], (f"{longer} ({number})" for number in count(2)))  # a path may be given twice
    return next(name for name in names if name not in taken)


@torch.no_grad()
def _views(opened: Opened, measured: Measured, most: int) -> list[ShownView]:
    """At most ``most`` views of a run for the page; memory holds one at a time at its full size."""
    from sundae_ns.report.report_page import choose_cameras, shown_view

    full, base = measured.full.views, measured.base.views if measured.has_head else None
    names = [path.name for path in opened.datamanager.eval_dataset.image_filenames]
    views = []
    for index in choose_cameras([view.psnr for view in full], most):
        outputs, photo = opened.model.get_outputs_for_camera(opened.cameras[index]), opened.truths[index]
        quality = full[index], None if base is None else base[index]
        views.append(shown_view(index, names[index], photo, outputs["rgb"], outputs["base_rgb"], *quality))
    return views
