"""``sundae report``: the quality, speed and size of finished runs, measured on their test views."""

from __future__ import annotations

import json
import shlex
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import BytesIO, StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sundae_ns.cli.outputs import Overwrite, check_file, check_folder
from sundae_ns.cli.process import loading
from sundae_ns.errors import ConfigError, SundaeError, writing

if TYPE_CHECKING:
    from PIL import Image

    from sundae_ns.evaluation import Measured
    from sundae_ns.evaluation.count_curve import CountCurve
    from sundae_ns.evaluation.curves import Curves
    from sundae_ns.evaluation.plots import Cost
    from sundae_ns.evaluation.report_page import ShownRun
    from sundae_ns.evaluation.shown_views import ShownView
    from sundae_ns.scenes.models import Opened

PNG_WIDTH = 400
"""Widest images, in pixels, whose comparison is written as PNG; wider ones are JPEG files, which are much smaller."""
COSTS: Mapping[Cost, str] = {"size": "size", "time": "time per frame", "primitives": "number of primitives"}
"""Axes of the plots of quality, with their names in titles."""


def report(
    runs: Annotated[list[Path], tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    data: Path | None = None,
    lpips_net: Literal["alex", "vgg", "squeeze"] = "alex",
    warmup: int = 3,
    repeats: int = 5,
    video: Path | None = None,
    overwrite: Overwrite = False,
) -> int:
    """Measure quality, speed and size of finished runs on their test views; write tables, plots and training curves.

    Args:
        runs: runs of sundae or splatfacto (their folders or config.yml), and packed scenes; no code in them runs.
        out: folder to write.
        data: folder of the capture, if it moved; packed scenes need it, because they do not record it.
        lpips_net: net of LPIPS, which is measured if its weights are on disk; values of different nets do not compare.
        warmup: untimed renderings of each view before timing.
        repeats: timed renderings of each view; 0 measures no times.
        video: .mp4 to write of one scene: base colours, compensated image and photograph of every view, side by side.
        overwrite: replace the files of an earlier report in the folder.
    """
    check_folder(out, reads=[*runs, data], overwrite=overwrite)
    if video is not None:
        if video.suffix.lower() != ".mp4":
            raise ConfigError(f"{video} does not end in .mp4, the only format of videos; rename it")
        if video.resolve().parent != out.resolve():  # the report's folder was checked
            check_file(video, reads=[*runs, data], overwrite=overwrite)
        if len(runs) > 1:
            raise ConfigError(f"a video shows one scene, and there are {len(runs)}; give one, or leave --video out")
    if not runs:
        raise ConfigError("there is nothing to report on; give the folders of finished runs")
    if warmup < 0 or repeats < 0:
        raise ConfigError(f"{warmup} warm-up renderings and {repeats} timed renderings; give at least 0 of each")
    with loading():
        from rich.console import Console
        from rich.markup import escape
        from rich.progress import MofNCompleteColumn, Progress, TaskID, TimeRemainingColumn

        from sundae_ns.evaluation import Lpips, csv_text, flip_available, lpips_weights_available
        from sundae_ns.evaluation.count_curve import read_count_curve
        from sundae_ns.evaluation.curves import read_curves
        from sundae_ns.evaluation.document import document
        from sundae_ns.evaluation.jod import INSTALL_JOD, jod_available
        from sundae_ns.evaluation.metrics import INSTALL_FLIP
        from sundae_ns.evaluation.report_page import ShownRun, report_page
        from sundae_ns.evaluation.shown_views import views_for_each
        from sundae_ns.scenes.measure import measure_scene
        from sundae_ns.scenes.models import load_model
        from sundae_ns.storage.atomic import write_files

    words = ["sundae", "report", *map(str, runs), "-o", str(out), "--lpips-net", lpips_net]
    words += ["--warmup", str(warmup), "--repeats", str(repeats), *(["--data", str(data)] if data else [])]
    command = shlex.join([*words, *(["--video", str(video)] if video else [])])
    lpips = Lpips(lpips_net, download=False) if lpips_weights_available(lpips_net) else None
    notes = []
    if not flip_available():
        notes.append(f"FLIP: the package is not installed; run {INSTALL_FLIP}.")
    if not jod_available():
        notes.append(f"JOD: the package is not installed; run {INSTALL_JOD}.")
    if lpips is None:
        notes.append(f"LPIPS: the weights of its net ({lpips_net}) are missing; sundae doctor says where to put them.")
    done: list[Measured] = []
    files: dict[Path, bytes] = {}
    curves: dict[str, Curves] = {}
    counts: dict[str, CountCurve] = {}
    comparisons: dict[str, list[tuple[str, str]]] = {}
    shown: dict[str, ShownRun] = {}
    failures: list[SundaeError] = []
    columns = (*Progress.get_default_columns()[:-1], MofNCompleteColumn(), TimeRemainingColumn())
    console = Console()
    with Progress(*columns, console=console, transient=True) as progress:
        scenes_done = progress.add_task("Scenes", total=len(runs))
        for number, path in enumerate(runs, start=1):
            task = progress.add_task(f"Opening {escape(str(path))}", total=None)

            def advance(task: TaskID = task) -> None:
                progress.advance(task)

            try:
                with redirect_stdout(StringIO()), redirect_stderr(StringIO()):  # nerfstudio's messages
                    opened = load_model(path, data=data)
                label = _label(opened, {run.label for run in done})
                progress.update(task, description=f"Measuring {escape(label)}", total=len(opened.cameras))
                measured = measure_scene(
                    opened,
                    label=label,
                    lpips=lpips,
                    warmup=warmup,
                    repeats=repeats,
                    progress=advance,
                    command=command,
                )
            except SundaeError as error:
                # Keep the measurements of the other runs.
                failures.append(error)
                notes.append(f"{path}: {error}")
            else:
                with writing(f"cannot write to {out}"):
                    out.mkdir(parents=True, exist_ok=True)
                kind = "png" if opened.truths[0].shape[1] <= PNG_WIDTH else "jpeg"
                name = f"errors-{number}.{kind.replace('jpeg', 'jpg')}"
                files[out / name] = _errors(opened, measured, kind)
                title = f"{label}: worst and median test view by PSNR"
                comparisons.setdefault(measured.scene, []).append((title, name))
                found = read_curves(opened.source) if opened.packed_bytes is None else None
                decided = read_count_curve(opened.source) if opened.packed_bytes is None else None
                counts |= {} if decided is None else {label: decided}
                if found is not None:
                    curves[label] = found
                    measured = replace(measured, peak_vram_mib=max(found.memory.values, default=0.0) or None)
                elif opened.packed_bytes is None:
                    notes.append(
                        f"Curves of {label}: {opened.source} holds no tensorboard event files; "
                        "train with --vis viewer+tensorboard to record them."
                    )
                progress.update(task, description=f"Encoding views of {escape(label)}")
                views = _views(opened, measured, views_for_each(len(runs)))
                shown[label] = ShownRun(measured, views, decided, capture=str(opened.capture.resolve()))
                done.append(measured)
                if video is not None:
                    total = len(opened.datamanager.train_dataset) + len(opened.cameras)
                    progress.update(task, description="Rendering the video", completed=0, total=total)
                    files[video] = _video(opened, advance)
            progress.remove_task(task)
            progress.advance(scenes_done)
        if not done:
            raise failures[0]
        progress.add_task("Plotting", total=None)
        scenes = {scene: [run for run in done if run.scene == scene] for scene in dict.fromkeys(r.scene for r in done)}
        plots, figures = _plot(scenes, curves, counts)
        notes += [
            f"Comparison within {scene}: its runs have different test views, so their numbers do not compare."
            for scene, own in scenes.items()
            if len({(run.resolution, len(run.full.views)) for run in own}) > 1
        ]
    images = {scene: [*plots[scene], *comparisons[scene]] for scene in scenes}
    rows = [run.as_json() for run in done]
    files |= {out / name: content for name, content in figures.items()}
    files[out / "report.json"] = (json.dumps(rows, indent=1) + "\n").encode()
    files[out / "report.csv"] = csv_text(rows).encode()
    runs_shown = {scene: [shown[run.label] for run in own] for scene, own in scenes.items()}
    # The page draws the curve of each run itself.
    drawn = {
        scene: [(title, figures[name]) for title, name in plots[scene] if not name.startswith("counts")]
        for scene in scenes
    }
    page = report_page(runs_shown, drawn, notes, command).encode()
    files[out / "report.html"] = page
    files[out / "report.md"] = document(scenes, images, notes, command).encode()
    write_files(files)
    for note in notes:
        console.print(f"[yellow]Left out: {escape(note)}", highlight=False)
    if video is not None:
        console.print(f"wrote {video}", highlight=False)
    console.print(f"wrote {out / 'report.md'}, with report.csv, report.json and images beside it", highlight=False)
    views_shown = sum(len(run.views) for run in shown.values())
    about = f"{len(page) / 1e6:.1f} MB, {views_shown} of {sum(len(run.full.views) for run in done)} views"
    console.print(f"wrote {out / 'report.html'}, to look at in a browser: {about}", highlight=False)
    return 1 if failures else 0


def _label(opened: Opened, taken: Collection[str]) -> str:
    """A short name for a run, different from those already taken."""
    label = "/".join(dict.fromkeys(part for part in (opened.variant, opened.method) if part))
    if label in taken:
        label += f"/{opened.source.name}"
    first, count = label, 1
    while label in taken:  # the same path is given twice
        count += 1
        label = f"{first} ({count})"
    return label


def _errors(opened: Opened, measured: Measured, kind: str) -> bytes:
    """A comparison image of the views with the lowest and the median PSNR, as ``png`` or ``jpeg``."""
    from sundae_ns.evaluation import comparison_sheet
    from sundae_ns.scenes.measure import comparison_of

    values = [view.psnr for view in measured.full.views]
    order = sorted(range(len(values)), key=values.__getitem__)
    chosen = {"worst": order[0], "median": order[len(order) // 2]}
    rows = [
        comparison_of(opened.model, opened.cameras[index], opened.truths[index], f"{name}: test view {index}")
        for name, index in chosen.items()
    ]
    file = BytesIO()
    comparison_sheet(rows).save(file, kind)
    return file.getvalue()


def _views(opened: Opened, measured: Measured, most: int) -> list[ShownView]:
    """The views of a run that the page shows, ``most`` or fewer; memory holds one at a time at its full size."""
    from sundae_ns.evaluation.shown_views import choose_views, shown_view
    from sundae_ns.scenes.measure import comparison_of

    full, base = measured.full.views, measured.base.views if measured.has_head else None
    names = [path.name for path in opened.datamanager.eval_dataset.image_filenames]
    shown = []
    for index in choose_views([view.psnr for view in full], most):
        row = comparison_of(opened.model, opened.cameras[index], opened.truths[index], names[index])
        shown.append(shown_view(row, index, full[index], None if base is None else base[index]))
    return shown


def _video(opened: Opened, progress: Callable[[], object]) -> bytes:
    """A video of every view of a scene beside its photograph; ``progress`` is called after each."""
    from sundae_ns.evaluation.video import side_by_side, write_video
    from sundae_ns.scenes.measure import largest_view, walk

    head = opened.model.state.head_enabled
    with redirect_stdout(StringIO()):  # nerfstudio says that it loads the training images
        tile = largest_view(opened)

    def frames() -> Iterator[Image.Image]:
        for row in walk(opened):
            yield side_by_side(row, tile, head=head)
            progress()

    with tempfile.TemporaryDirectory() as folder:  # the index moves to the front of a file, not of a stream
        path = Path(folder) / "views.mp4"
        write_video(path, frames())
        return path.read_bytes()


def _plot(
    scenes: Mapping[str, list[Measured]], curves: Mapping[str, Curves], counts: Mapping[str, CountCurve]
) -> tuple[dict[str, list[tuple[str, str]]], dict[str, bytes]]:
    """Draw all plots; returns (title, file name) by scene, and contents by file name."""
    from sundae_ns.evaluation.plots import MOST_SERIES, colors_of, plot_counts, plot_curves, plot_quality, plot_views

    titles: dict[str, list[tuple[str, str]]] = {}
    files: dict[str, bytes] = {}
    for number, (scene, runs) in enumerate(scenes.items(), start=1):
        end = "" if len(scenes) == 1 else f"-{number}"
        colors = colors_of([run.label for run in runs])
        plots = titles.setdefault(scene, [])

        def drawn(plot: Callable[..., bool | None], title: str, name: str, /, *arguments: Any, **options: Any) -> None:
            file = BytesIO()
            if plot(file, *arguments, **options) is not False:
                files[name] = file.getvalue()
                plots.append((title, name))  # noqa: B023

        for cost, cost_name in COSTS.items():
            drawn(plot_quality, f"Quality against {cost_name}", f"quality-{cost}{end}.png", runs, cost, colors)
        # One figure for every few runs, so that colours tell their lines apart.
        for first in range(0, len(runs), MOST_SERIES):
            group = runs[first : first + MOST_SERIES]
            names = f"{end}-from-{first + 1}" if first else end
            drawn(plot_views, "PSNR of each test view", f"views{names}.png", group, colors)
            known = {run.label: curves[run.label] for run in group if run.label in curves}
            for place, run in enumerate(group, start=first + 1):
                if run.label in counts:
                    title, name = "Expected quality against the number of primitives", f"counts{end}-{place}.png"
                    about = f"{run.label}: trials on held-out training views"
                    drawn(plot_counts, title, name, counts[run.label], title=about)
            if known:
                drawn(plot_curves, "Training curves", f"curves{names}.png", known, colors, title=f"{scene}: training")
    return titles, files
