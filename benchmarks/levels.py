"""Levels of detail of full fields, beside PlayCanvas's decimation of the same count; print one CSV row for each level.

    python benchmarks/levels.py FIELD ... -o benchmarks/results/levels.csv                         # ours, best on a GPU
    python benchmarks/levels.py FIELD ... --tools splat-transform --decimated DIR -o benchmarks/results/levels.csv

``sundae`` makes levels as ``sundae export --lod`` does. Those of ``splat-transform`` are ``DIR/NAME_50.sog`` and so on;
missing ones are made with ``--splat-transform COMMAND``, by ``--decimate`` on its CPU path. All are written as .sog by
one program, read again, and compared with the images of the full field in 32 virtual cameras, which no tool was given;
``DIR/NAME.cameras.json`` keeps them, so that every machine has the same. Rows of ``-o`` that are there are kept.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory
from typing import Any

from prune_without_photos import OTHER, decimated, device_of

import sundae_ns as sn
from harness.rows import Rows
from sundae_ns.core.timing import now
from sundae_ns.plugin.distill import LEVELS, levels_of
from sundae_ns.rasterize.interface import fastest_device

COLUMNS = ("field", "share", "tool", "gaussians", "psnr_to_field", "psnr_worst", "seconds", "device")
OURS = "sundae"


def held_out(scene: sn.Scene, path: Path) -> list[sn.Camera]:
    """The cameras of a file; virtual ones if it is missing, which are written to it."""
    if not path.exists():
        cameras = sn.virtual_cameras(scene.to("cpu"), 32, seed=10_000, size=512)
        poses = [[*camera.pose.double().flatten().tolist(), 0.0, 0.0, 0.0, 1.0] for camera in cameras]
        path.parent.mkdir(parents=True, exist_ok=True)
        entries = [{"camera_to_world": pose, "fov": 40.0} for pose in poses]
        path.write_text(json.dumps({"render_width": 512, "render_height": 512, "camera_path": entries}))
    return sn.cameras_of(path)


def others(scene: sn.Scene, name: str, options: argparse.Namespace) -> Iterator[tuple[sn.Scene, float]]:
    """The levels of the other program, and the seconds that each took; 0 for one that was there."""
    for share in LEVELS:
        path, seconds = options.decimated / f"{name}_{round(100 * share)}.sog", 0.0
        if not path.exists():
            count = str(round(share * scene.num_gaussians))
            with TemporaryDirectory() as folder:
                small, seconds = decimated(scene, options.splat_transform, "decimate", count, Path(folder))
            sn.save(small, path)
        yield sn.load(path, device=scene.device), seconds


def trained(scene: sn.Scene, folder: Path) -> Iterator[tuple[sn.Scene, float]]:
    """Our levels, and the seconds that each took."""
    began = now(scene.device)
    for level, _ in levels_of(scene):
        seconds = now(scene.device) - began
        sn.save(level, folder / "level.sog")
        yield sn.load(folder / "level.sog", device=scene.device), seconds
        began = now(scene.device)


def rows_of(path: Path, tool: str, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The rows of a field."""
    scene = sn.load(path, device=fastest_device())
    cameras = held_out(scene, options.decimated / f"{path.stem}.cameras.json")
    images = [sn.render(scene, camera).rgb for camera in cameras]
    with TemporaryDirectory() as folder:
        levels = trained(scene, Path(folder)) if tool == OURS else others(scene, path.stem, options)
        for share, (level, seconds) in zip(LEVELS, levels, strict=True):
            values = [sn.measure(level, [image], [camera]).psnr for image, camera in zip(images, cameras, strict=True)]
            figures = (level.num_gaussians, f"{mean(values):.3f}", f"{min(values):.3f}", f"{seconds:.1f}")
            yield dict(zip(COLUMNS, (path.stem, share, tool, *figures, device_of(scene)), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", nargs="+", type=Path, help="files of full fields; their names tell them apart")
    parser.add_argument("-o", "--out", type=Path, help="table of results")
    parser.add_argument("--tools", nargs="+", choices=(OURS, OTHER), default=[OURS])
    parser.add_argument("--decimated", type=Path, default=Path("decimated"), help="folder of the other's levels")
    parser.add_argument("--splat-transform", default=OTHER, help="its command, with options if it needs any")
    options = parser.parse_args()
    rows = Rows(options.out, COLUMNS, ("field", "share", "tool"))
    for path in options.fields:
        for tool in options.tools:
            if not all({"field": path.stem, "share": share, "tool": tool} in rows for share in LEVELS):
                for row in rows_of(path, tool, options):
                    rows.put(row)


if __name__ == "__main__":
    main()
