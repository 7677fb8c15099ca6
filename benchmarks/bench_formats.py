"""Measure a finished run in every packed format, on its own test views; print one CSV row a format.

    python benchmarks/bench_formats.py RUN                                   # a run of splatfacto or sundae
    python benchmarks/bench_formats.py RUN -o benchmarks/results/formats.csv

The formats are fp32 (the run itself), .ply, .spz and .sog by ``sundae export``, .sundae by ``sundae pack`` with the
head if there is one, and .sog by PlayCanvas's ``splat-transform`` where it is in PATH (``npm install -g
@playcanvas/splat-transform``, node 22; it needs a GPU by Vulkan: with ``--splat-transform "splat-transform --gpu cpu"``
100,000 Gaussians took more than eight minutes). Each file is loaded again by ``sundae_ns.load`` and rendered over the
background of the run. Bytes are those of the whole file; fp32 counts Gaussians, features and head. With ``-o``, rows
take the place of those of the same capture, method, format, program and seed. ``benchmarks/tables.py`` shows
results/formats.csv.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import sundae_ns as sn
from harness.rows import Rows
from sundae_ns.core.gaussians import bytes_of
from sundae_ns.head.head import bytes_of_module
from sundae_ns.plugin.dataparsers import camera_of
from sundae_ns.plugin.finished_runs import Opened, load_model, load_run
from sundae_ns.scene.page import packed_of

COLUMNS = tuple("capture method format program bytes psnr ssim primitives seed command".split())
OURS = "sundae_ns"
OTHER = "splat-transform"


class Packed(NamedTuple):
    """A file of the run, and how it was made."""

    file: Path
    program: str
    command: str


def version_of(program: str) -> str:
    """The name of splat-transform with its version: ``splat-transform 3.7.0``."""
    found = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    number = re.search(r"\d+(\.\d+)+", found.stdout + found.stderr)
    return f"{OTHER} {number[0]}" if number else OTHER


def packed_files(run: Path, scene: sn.Scene, folder: Path, data: Path | None, program: str | None) -> Iterator[Packed]:
    """Write the run in each format into ``folder``, one after the other."""
    for kind in (".ply", ".spz", ".sog"):
        sn.save(scene, folder / f"scene{kind}")
        yield Packed(folder / f"scene{kind}", OURS, f"sundae export RUN -o scene{kind}")
    packed = folder / "scene.sundae"
    packed.write_bytes(packed_of(load_run(run, data=data)))
    yield Packed(packed, OURS, "sundae pack RUN -o scene.sundae")
    if program is not None:
        theirs = folder / "theirs.sog"
        words = shlex.split(program)
        made = subprocess.run([*words, "--quiet", "--overwrite", str(folder / "scene.ply"), str(theirs)], check=False)
        if made.returncode:
            print(f"{program} has failed, so its row is missing; has it a GPU?", file=sys.stderr)
            return
        yield Packed(theirs, version_of(words[0]), shlex.join([OTHER, *words[1:], "scene.ply", "scene.sog"]))


def rows_of(opened: Opened, files: Iterator[Packed], scene: sn.Scene) -> Iterator[dict[str, Any]]:
    """A row for the run in fp32, then one for each file."""
    cameras = [camera_of(camera, scene.device) for camera in opened.cameras]

    def row(measured: sn.Scene, kind: str, program: str, count: int, command: str) -> dict[str, Any]:
        # Files for viewers state no background.
        shown = dataclasses.replace(measured, background_color=scene.background_color)
        quality = sn.measure(shown, opened.truths, cameras)
        figures = (count, round(quality.psnr, 4), round(quality.ssim, 4), measured.num_gaussians)
        seed = "" if opened.seed is None else opened.seed
        return dict(zip(COLUMNS, (opened.scene, opened.method, kind, program, *figures, seed, command), strict=True))

    stored = bytes_of(scene.gaussians) + (0 if scene.head is None else bytes_of_module(scene.head))
    yield row(scene, "fp32", "", stored, f"ns-train {opened.method}")
    for packed in files:
        loaded = sn.load(packed.file, device=scene.device)
        yield row(loaded, packed.file.suffix, packed.program, packed.file.stat().st_size, packed.command)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a finished run of splatfacto or sundae")
    parser.add_argument("-o", "--out", type=Path, help="CSV file to put the rows into")
    parser.add_argument("--data", type=Path, help="the capture, if it has moved")
    parser.add_argument("--splat-transform", default=shutil.which(OTHER), help="its command, with options if need be")
    options = parser.parse_args()

    opened = load_model(options.run, data=options.data)
    scene = sn.load(options.run, device=opened.model.device)
    with tempfile.TemporaryDirectory() as name:
        files = packed_files(options.run, scene, Path(name), options.data, options.splat_transform)
        rows = Rows(options.out, COLUMNS, ("capture", "method", "format", "program", "seed"))
        for row in rows_of(opened, files, scene):
            rows.put(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
