"""``sundae report``: finished scenes evaluated on their test views in one go, speed beside error."""

from __future__ import annotations

import csv
import json
import shlex
from collections.abc import Collection, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import astuple, replace
from io import StringIO
from pathlib import Path

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeRemainingColumn

from sundae_ns.errors import ConfigError, SundaeError
from sundae_ns.evaluation import COLUMNS, Lpips, Measured, flip_available, lpips_weights_available, save_comparison
from sundae_ns.evaluation.curves import Curves, read_curves
from sundae_ns.evaluation.document import document
from sundae_ns.evaluation.flip import INSTALL
from sundae_ns.evaluation.lpips import Net
from sundae_ns.evaluation.plots import colors_of, plot_costs, plot_curves, plot_gain, plot_views
from sundae_ns.evaluation.published import Printed, printed_of
from sundae_ns.scenes.measure import measure_scene, pictures_of
from sundae_ns.scenes.opening import Opened, open_scene
from sundae_ns.storage.atomic import write_text, writing

PNG_WIDTH = 400
"""Widest pictures, pixels, whose error maps are written without loss; larger ones would take many megabytes."""


def run_report(
    paths: Sequence[Path],
    out: Path,
    *,
    data: Path | None = None,
    lpips_net: Net = "alex",
    warmup: int = 3,
    repeats: int = 5,
    console: Console | None = None,
) -> int:
    """Measure and write; options are those of the command. The exit code: 1 if a run had to be left out.

    Raises:
        ConfigError: nothing to report on, or a number that cannot work.
        CheckpointError: no path can be opened; this of the first.
        DataError: no run has its capture with test views; this of the first.
        StorageError: the folder cannot be written to.
    """
    if not paths:
        raise ConfigError("there is nothing to report on: give the folders of finished runs")
    if warmup < 0 or repeats < 0:
        raise ConfigError(f"{warmup} warm-up renderings and {repeats} timed ones; give at least 0 of each")
    console = console or Console()
    with writing(f"cannot make {out}"):
        out.mkdir(parents=True, exist_ok=True)
    words = ["sundae", "report", *map(str, paths), "-o", str(out), "--lpips-net", lpips_net]
    words += ["--warmup", str(warmup), "--repeats", str(repeats), *(["--data", str(data)] if data else [])]
    command = shlex.join(words)
    lpips = Lpips(lpips_net, download=False) if lpips_weights_available(lpips_net) else None
    runs: list[Measured] = []
    curves: dict[str, Curves] = {}
    notes = _missing_metrics(lpips_net, lpips)
    pictures: dict[str, list[tuple[str, str]]] = {}
    failures: list[SundaeError] = []
    columns = (*Progress.get_default_columns()[:-1], MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        everything = progress.add_task("Scenes", total=len(paths))
        for number, path in enumerate(paths, start=1):
            task = progress.add_task(f"Opening {path}", total=None)
            try:
                opened = _quietly(path, data)
                label = _label(opened, {run.label for run in runs})
                progress.update(task, description=f"Measuring {label}", total=len(opened.cameras))
                measured = measure_scene(
                    opened,
                    label=label,
                    lpips=lpips,
                    warmup=warmup,
                    repeats=repeats,
                    progress=lambda task=task: progress.advance(task),  # type: ignore[misc]
                    command=command,
                )
            except SundaeError as error:
                # What was measured of the others is not to be lost.
                failures.append(error)
                notes.append(f"{path}: {error}")
            else:
                name = f"errors-{number}.{'png' if opened.truths[0].shape[1] <= PNG_WIDTH else 'jpg'}"
                _error_maps(out / name, opened, measured)
                pictures.setdefault(measured.scene, []).append((f"{label}: worst and median view", name))
                found = read_curves(opened.curves) if opened.curves is not None else None
                if found is not None:
                    curves[label] = found
                    measured = replace(measured, peak_vram_mib=max(found.memory.values, default=0.0) or None)
                elif opened.curves is not None:
                    notes.append(
                        f"Curves of {label}: there are no event files of tensorboard in {opened.curves}; "
                        "--vis viewer+tensorboard writes them."
                    )
                runs.append(measured)
            progress.remove_task(task)
            progress.advance(everything)
        if not runs:
            raise failures[0]
        progress.add_task("Drawing", total=None)
        scenes = {scene: [run for run in runs if run.scene == scene] for scene in dict.fromkeys(r.scene for r in runs)}
        printed = {scene: printed_of(scene, own[0].resolution) for scene, own in scenes.items()}
        plots = _draw(out, scenes, printed, curves)
        notes += _differences(scenes)
    plots = {scene: [*plots[scene], *pictures[scene]] for scene in scenes}
    write_text(out / "report.json", json.dumps([run.as_json() for run in runs], indent=1) + "\n")
    write_text(out / "report.csv", _csv(runs))
    write_text(out / "report.md", document(scenes, printed, plots, notes, command))
    for note in notes:
        console.print(f"[yellow]Left out: {note}", highlight=False)
    console.print(f"wrote {out / 'report.md'}, with report.csv, report.json and pictures beside it", highlight=False)
    return 1 if failures else 0


def _quietly(path: Path, data: Path | None) -> Opened:
    """Open a scene without what nerfstudio says meanwhile."""
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        return open_scene(path, data=data)


def _label(opened: Opened, taken: Collection[str]) -> str:
    """A short name, one of a kind."""
    label = "/".join(dict.fromkeys(part for part in (opened.variant, opened.method) if part))
    if label in taken:
        label += f"/{opened.source.name}"
    first, count = label, 1
    while label in taken:  # the same path given twice
        count += 1
        label = f"{first} ({count})"
    return label


def _missing_metrics(net: Net, lpips: Lpips | None) -> list[str]:
    notes = []
    if not flip_available():
        notes.append(f"FLIP: its authors' package is not installed ({INSTALL}).")
    if lpips is None:
        notes.append(f"LPIPS: the weights of its net ({net}) are not at hand; sundae doctor says where they belong.")
    return notes


def _differences(scenes: dict[str, list[Measured]]) -> list[str]:
    """A warning for each scene whose runs were not measured on the same pictures."""
    return [
        f"Comparison within {scene}: its runs have different test views, so their figures do not compare."
        for scene, own in scenes.items()
        if len({(run.resolution, len(run.full.views)) for run in own}) > 1
    ]


def _error_maps(path: Path, opened: Opened, measured: Measured) -> None:
    """Truth, base, whole picture and error of the worst view and of the median one."""
    values = [view.psnr for view in measured.full.views]
    order = sorted(range(len(values)), key=values.__getitem__)
    rows = []
    for name, index in (("worst", order[0]), ("median", order[len(order) // 2])):
        rows.append(replace(pictures_of(opened, index), title=f"{name}: view {index}"))
    save_comparison(path, rows)


def _draw(
    out: Path, scenes: dict[str, list[Measured]], printed: dict[str, list[Printed]], curves: dict[str, Curves]
) -> dict[str, list[tuple[str, str]]]:
    """Write all plots; (title, file name) by scene."""
    drawn: dict[str, list[tuple[str, str]]] = {}
    for number, (scene, own) in enumerate(scenes.items(), start=1):
        end = "" if len(scenes) == 1 else f"-{number}"
        colors = colors_of([run.label for run in own])
        plots = drawn.setdefault(scene, [])
        plot_costs(out / f"cost{end}.png", own, colors, printed[scene])
        plots.append(("Quality against time, bytes and primitives", f"cost{end}.png"))
        if plot_gain(out / f"gain{end}.png", own, colors):
            plots.append(("What the head adds, against the time that it adds", f"gain{end}.png"))
        plot_views(out / f"views{end}.png", own, colors)
        plots.append(("PSNR of every test view", f"views{end}.png"))
        known = {run.label: curves[run.label] for run in own if run.label in curves}
        if known:
            plot_curves(out / f"curves{end}.png", known, colors)
            plots.append(("Over training", f"curves{end}.png"))
    return drawn


def _csv(runs: Sequence[Measured]) -> str:
    buffer = StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(astuple(run.row()) for run in runs)
    return buffer.getvalue()
