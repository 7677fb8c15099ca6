"""``sundae compare``: what scenes show, weigh and take, against each other or against photos."""

from __future__ import annotations

import json
import shlex
import sys
from contextlib import redirect_stderr
from dataclasses import replace
from functools import partial
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro
from rich.markup import escape

from sundae_ns.cli.inputs import chosen_cameras, is_run, open_run
from sundae_ns.cli.main import typed
from sundae_ns.cli.options import File, Flag, Float, Int, Overwrite, progress_bar
from sundae_ns.cli.refusals import check_folder, check_least
from sundae_ns.core.errors import ConfigError, SundaeError
from sundae_ns.core.files import write_files
from sundae_ns.core.metrics import Lpips, Net, lpips_weights
from sundae_ns.io.formats import FORMATS
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.report.measure import against_first, against_photos, csv_text, labels_of, markdown, measure
from sundae_ns.report.report_page import ShownRun, report_page, shown_views
from sundae_ns.scene.describe import HELD_OUT, held_out_cameras
from sundae_ns.scene.load_save import load, no_scene, save
from sundae_ns.train.curve import read_count_curve


def compare(
    scenes: Annotated[list[Path], tyro.conf.Positional, tyro.conf.arg(metavar="PATH ...", help_behavior_hint="")],
    out: Annotated[File, tyro.conf.arg(aliases=["-o"])] = None,
    data: File = None,
    cameras: File = None,
    num_cameras: int = HELD_OUT,
    formats: Flag = False,
    min_psnr: Float = None,
    lpips_net: Net = "alex",
    repeats: Int = None,
    overwrite: Overwrite = False,
) -> int:
    """Compare scenes by PSNR, SSIM, worst view and bytes: a table, and a page with sliders.

    Runs of training, and all files with --data, are compared with the test photos of their capture, and timed. Other
    files are compared with the images of the first one: from its stored cameras, else from virtual ones.

    Args:
        scenes: files and runs of all kinds that sundae reads; no code in them runs.
        out: folder for a web page with sliders (report.html), and for the table as report.md, .csv and .json.
        data: capture whose test photos are the truth, or that of a run if it has moved.
        cameras: transforms.json, COLMAP model, camera path, run or pack: images of the first scene by it are the truth.
        num_cameras: most cameras, evenly spaced, or the number of virtual ones.
        formats: compare a scene with itself in every format: what each costs.
        min_psnr: exit with 1 if the mean PSNR of a scene is lower, dB.
        lpips_net: net of LPIPS, which is measured against photos if its weights are on disk.
        repeats: timed renderings of each view; 0 measures no times. By default 5 against photos, else 0.
    """
    if out is not None:
        check_folder(out, reads=[*scenes, data, cameras], overwrite=overwrite)
    check_least(repeats=(repeats, 0), num_cameras=(num_cameras, 1))
    if missing := next((path for path in scenes if not path.exists()), None):
        raise no_scene(missing)
    scenes = sorted(scenes, key=lambda path: not is_run(path))  # a run says how photos are read
    photos = cameras is None and (data is not None or any(map(is_run, scenes)))
    if len(scenes) < (1 if photos or formats else 2):
        raise ConfigError("a comparison needs two scenes; give another, --formats, or --data with a capture")
    if formats and len(scenes) > 1:
        raise ConfigError(f"--formats compares one scene with itself; leave out {scenes[1]}, or --formats")
    first = None if photos else load(scenes[0]).to(fastest_device())
    command = shlex.join(["sundae", *typed])
    repeats = (5 if photos else 0) if repeats is None else repeats
    lpips = Lpips(lpips_net) if photos and lpips_weights(lpips_net)[1].is_file() else None
    unmeasured = f"LPIPS: the weights of its net ({lpips_net}) are missing; sundae doctor says where to put them."
    notes = [unmeasured] if photos and lpips is None else []
    done: list[ShownRun] = []
    failures: list[SundaeError] = []
    measured_by = partial(measure, lpips=lpips, repeats=repeats, command=command)
    with progress_bar() as progress, TemporaryDirectory() as folder:
        if formats:
            source = open_run(scenes[0], max_cameras=100, data=data) if is_run(scenes[0]) else first or load(scenes[0])
            suffixes = (suffix for suffix in (*FORMATS, ".sundae") if suffix != scenes[0].suffix.lower())
            scenes += [Path(folder, scenes[0].stem + suffix) for suffix in suffixes]
        opened = against_photos(data)
        if first is not None:
            chosen, _ = chosen_cameras(first, cameras, num_cameras)
            opened = against_first(scenes[0], first, held_out_cameras(first, chosen, num_cameras))
        for path, label in zip(scenes, labels_of(scenes), strict=True):
            task = progress.add_task(f"Opening {escape(label)}", total=None)
            try:
                if formats and path != scenes[0]:
                    with redirect_stderr(StringIO()) as said:
                        save(source, path)
                    print(said.getvalue().replace(str(path), f"{scenes[0]} as {path.suffix}"), end="", file=sys.stderr)
                subject = opened(path)
                progress.update(task, description=f"Measuring {escape(label)}", total=len(subject.truths))
                measured = measured_by(subject, label=label, progress=partial(progress.advance, task))
                measured = replace(measured, source=str(scenes[0] if formats else measured.source))
                views = [] if out is None else shown_views(subject, measured, len(scenes))
                curve = read_count_curve(Path(measured.source)) if subject.file_bytes is None else None
                done.append(ShownRun(measured, views, curve, subject.capture))
            except SundaeError as error:  # keep the measurements of the others
                failures.append(error)
                notes.append(f"{path}: {error}".replace(str(path), label))
            progress.remove_task(task)
    if not done:
        raise failures[0]
    runs = [each.measured for each in done]
    groups = {name: [run for run in runs if run.scene == name] for name in dict.fromkeys(run.scene for run in runs)}
    notes += [
        f"Comparison within {name}: its scenes have different views, so their numbers do not compare."
        for name, group in groups.items()
        if len({(run.resolution, len(run.full.views)) for run in group if run.full.views}) > 1
    ]
    print(markdown(groups, notes), end="")
    if out is not None:
        page = report_page(done, notes, command, "photo" if photos else scenes[0].name)
        rows = [run.as_json() for run in runs]
        files = {"json": json.dumps(rows, indent=1), "csv": csv_text(rows), "md": markdown(groups, notes), "html": page}
        write_files({out / f"report.{kind}": text.encode(errors="backslashreplace") for kind, text in files.items()})
        print(f"wrote {out / 'report.html'}, for a browser ({len(page) / 1e6:.1f} MB), report.md, .csv and .json")
    means = {run.label: run.full.mean("psnr") for run in runs if run.full.views}
    if low := [] if min_psnr is None else [label for label, psnr in means.items() if psnr is None or psnr < min_psnr]:
        print(f"below {min_psnr:g} dB: {', '.join(low)}", file=sys.stderr)
    return 1 if failures or low else 0
