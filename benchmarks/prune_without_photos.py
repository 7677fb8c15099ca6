"""Make full fields small without their photos, by tools and shares; print one CSV row for each small field.

    python benchmarks/prune_without_photos.py RUN ... -o benchmarks/results/prune.csv
    python benchmarks/prune_without_photos.py RUN --splat-transform splat-transform     # beside PlayCanvas's decimation
    python benchmarks/prune_without_photos.py RUN --shares 0.5 0.1 --training none

A run of sundae or splatfacto is a full field, and its capture has the test views. ``psnr_to_field`` compares them
with the full field's own images, ``psnr`` and ``ssim`` with the photographs, and ``psnr_virtual`` compares virtual
views that no tool was given with the full field. Tools and rules: ``sundae_ns`` by virtual views (``pairs``, the
default), and ``splat-transform`` by ``--decimate`` and ``--decimate-adaptive``, on its CPU path. Training is none, or
that of ``sundae prune --distill``: ``distill`` with a head where it pays, ``distill-no-head`` without. ``bytes`` are of
the .sundae file, ``bytes_sog`` of the base colours as .sog. With ``-o`` rows that are there are not measured again.
"""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

import sundae_ns as sn
from harness.rows import Rows
from sundae_ns.core.errors import SundaeError
from sundae_ns.core.timing import now
from sundae_ns.plugin.dataparsers import camera_of
from sundae_ns.plugin.finished_runs import load_model

COLUMNS = """capture tool rule training share primitives bytes bytes_sog psnr_to_field psnr ssim psnr_virtual seconds
device seed steps""".split()
NAMING = ("capture", "tool", "rule", "training", "share", "device", "seed", "steps")
OURS, OTHER = "sundae_ns", "splat-transform"
RULE = sn.PruneRule()
TRAININGS = ("none", "distill", "distill-no-head")
HELD_OUT = 32


class Full(NamedTuple):
    """A full field with its test views."""

    capture: str
    scene: sn.Scene
    cameras: list[sn.Camera]
    photos: list[Tensor]
    images: list[Tensor]
    virtual: list[sn.Camera]


def full_field(run: Path, data: Path | None) -> Full:
    """Open a run with its test views."""
    opened = load_model(run, data=data)
    device = opened.model.device
    scene = dataclasses.replace(sn.load(run, device=device), head=None)
    cameras = [camera_of(ns_camera, device) for ns_camera in opened.cameras]
    images = [sn.render(scene, camera).rgb for camera in cameras]
    virtual = sn.virtual_cameras(scene, HELD_OUT, seed=10_000, size=256)
    return Full(opened.scene, scene, cameras, opened.truths, images, virtual)


def device_of(scene: sn.Scene) -> str:
    """Name of the device that the work runs on."""
    return torch.cuda.get_device_name(scene.device) if scene.device.type == "cuda" else "cpu"


def decimated(scene: sn.Scene, program: str, option: str, amount: str, folder: Path) -> tuple[sn.Scene, float]:
    """The scene of splat-transform's ``--option amount``, on its CPU path, and the seconds that it took."""
    source, out = folder / "full.ply", folder / "small.ply"
    if not source.exists():
        sn.save(scene, source)
    began = now("cpu")
    words = [*shlex.split(program), "--gpu", "cpu", "--quiet", "-w", str(source), f"--{option}", amount, str(out)]
    subprocess.run(words, check=True, stdout=sys.stderr)
    seconds = now("cpu") - began
    return sn.load(out, device=scene.device), seconds


def jobs(full: Full, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The rows to make, without their figures."""
    for share in options.shares:
        about = {"capture": full.capture, "share": share, "device": device_of(full.scene), "seed": options.seed}
        for training in dict.fromkeys(["none", *options.training]):
            steps = 0 if training == "none" else options.steps
            yield {**about, "tool": OURS, "rule": RULE.selection, "training": training, "steps": steps}
        for rule in ("decimate", "decimate-adaptive") if options.splat_transform else ():
            yield {**about, "tool": OTHER, "rule": rule, "training": "none", "steps": 0}


def made(full: Full, job: dict[str, Any], options: argparse.Namespace, folder: Path) -> tuple[sn.Scene, float]:
    """The small scene of a job, and the seconds that it took, without loading and saving."""
    began, scene, share = now(full.scene.device), full.scene, job["share"]
    if job["tool"] == OTHER:
        small, seconds = decimated(scene, options.splat_transform, job["rule"], f"{100 * share:g}%", folder)
        return dataclasses.replace(scene, gaussians=small.gaussians), seconds
    if job["training"] == "none":
        rule = dataclasses.replace(RULE, seed=options.seed)
        small = sn.prune(scene, keep=share, cameras=sn.virtual_cameras(scene, seed=options.seed), rule=rule)
    else:
        head = job["training"] == "distill"
        small = sn.distill(scene, keep=share, steps=options.steps, seed=options.seed, head=head)
    return small, now(scene.device) - began


def row_of(full: Full, job: dict[str, Any], options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """One row with its figures."""
    small, seconds = made(full, job, options, folder)
    sizes = {}
    for suffix in (".sundae", ".sog"):
        file = folder / f"small{suffix}"
        sn.save(small, file)
        sizes[suffix] = file.stat().st_size
    photos = sn.measure(small, full.photos, full.cameras)
    return {
        **job,
        "primitives": small.num_gaussians,
        "bytes": sizes[".sundae"],
        "bytes_sog": sizes[".sog"],
        "psnr_to_field": f"{sn.measure(small, full.images, full.cameras).psnr:.3f}",
        "psnr": f"{photos.psnr:.3f}",
        "ssim": f"{photos.ssim:.4f}",
        "psnr_virtual": f"{sn.measure(small, full.scene, full.virtual).psnr:.3f}",
        "seconds": f"{seconds:.1f}",
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="runs of full fields")
    parser.add_argument("-o", "--out", type=Path, help="table of results; rows that are there are kept")
    parser.add_argument("--data", type=Path, help="the capture, if it has moved")
    parser.add_argument("--shares", nargs="+", type=float, default=[0.5, 0.2, 0.1, 0.05])
    parser.add_argument("--training", nargs="+", choices=TRAININGS, default=list(TRAININGS))
    parser.add_argument("--steps", type=int, default=3000, help="steps of a distillation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--splat-transform", help="command of splat-transform, with options if it needs any")
    options = parser.parse_args()
    rows, failed = Rows(options.out, COLUMNS, NAMING), 0
    for run in options.runs:
        try:
            full = full_field(run, options.data)
        except SundaeError as error:
            print(f"{run}: {error}", file=sys.stderr)
            failed = 1
            continue
        with tempfile.TemporaryDirectory() as folder:
            for job in jobs(full, options):
                if job in rows:
                    continue
                try:
                    rows.put(row_of(full, job, options, Path(folder)))
                except (SundaeError, OSError, subprocess.CalledProcessError) as error:
                    print(f"{job}: {error}", file=sys.stderr)
                    failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(main())
