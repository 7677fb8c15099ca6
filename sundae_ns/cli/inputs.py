"""What commands read: a scene, its cameras, and what to cut from it before anything else."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from sundae_ns.cli.options import Flag
from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import DataError
from sundae_ns.io.config_file import check_run, find_config
from sundae_ns.io.formats import kind_of
from sundae_ns.io.ply import has_own_columns
from sundae_ns.scene.cameras import cameras_of
from sundae_ns.scene.load_save import load, packed_file
from sundae_ns.scene.page import packed_of
from sundae_ns.scene.prune_scene import crop_mask, floater_mask
from sundae_ns.scene.scene import Scene
from sundae_ns.scene.virtual_cameras import VIEWS


@dataclass(frozen=True)
class Cleaning:
    """What to cut, before anything else."""

    crop: tuple[float, float, float, float, float, float] | None = None
    """keep the Gaussians whose centres are in this box: its lowest x y z, then its highest, in the coordinates of the
    scene."""
    remove_floaters: Flag = False
    """remove small groups of Gaussians that touch no other, and what none of the cameras of the photographs sees."""

    @property
    def chosen(self) -> str:
        """Name of the first option that is given, or empty."""
        floaters = "--remove-floaters" if self.remove_floaters else ""
        return floaters if self.crop is None else "--crop"

    def mask(self, scene: Scene, cameras: Sequence[Camera]) -> Tensor:
        """True for Gaussians that stay, bool ``[N]``; prints their numbers to stderr."""
        mask = torch.ones(scene.num_gaussians, dtype=torch.bool, device=scene.device)
        if self.crop is not None:
            mask = crop_mask(scene, self.crop[:3], self.crop[3:])
            print(f"{int(mask.sum()):,} of {len(mask):,} Gaussians are in the box", file=sys.stderr)
        if self.remove_floaters:
            floats = floater_mask(scene[mask], cameras, console=Console(stderr=True))
            mask[mask.clone()] = ~floats
            rule = "" if cameras else ", by their neighbours alone: no camera of the photographs is known"
            print(f"removed {int(floats.sum()):,} floaters of {len(floats):,} Gaussians{rule}", file=sys.stderr)
            if not bool(mask.any()):
                raise DataError("all Gaussians float; leave out --remove-floaters")
        return mask

    def cleaned(self, scene: Scene) -> Scene:
        """The scene without what :meth:`mask` cuts, by the cameras stored with it."""
        return scene[self.mask(scene, scene.cameras)] if self.chosen else scene


def open_run(run: Path, **options: Any) -> Scene:
    """The scene of a run with cameras of its capture; options as :func:`.finished_runs.load_run`."""
    check_run(run)  # before nerfstudio is imported, which takes seconds
    from sundae_ns.plugin.finished_runs import load_run

    # nerfstudio prints messages while it reads a capture.
    with Console(file=sys.stderr).status("Reading the run"), redirect_stdout(StringIO()):
        return load_run(run, **options)


def open_scene(path: Path, data: Path | None) -> Scene:
    """A scene; that of a run, whose capture may have moved, has cameras of it."""
    return open_run(path, data=data) if is_run(path) else load(path)


def open_packed(path: Path, data: Path | None) -> tuple[Scene, bytes]:
    """As :func:`open_scene`, with the packed file that holds it; others are packed in memory."""
    if not is_run(path):
        return packed_file(path)
    scene = open_scene(path, data)
    return scene, packed_of(scene)


def name_of(path: Path) -> str:
    """The name of a scene: that of its file; of a run, whose folder is CAPTURE/METHOD/TIME, that of its capture."""
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    return (folder.parents[1].name or folder.name) if is_run(path) else path.resolve().stem


def is_run(path: Path) -> bool:
    """Whether a path is the folder of a run, or its ``config.yml``."""
    return (path.is_dir() or path.name == "config.yml") and find_config(path) is not None


def chosen_cameras(scene: Scene, cameras: Path | None, most: int | None) -> Sequence[Camera]:
    """Cameras of a file, or at most ``most`` of a run; by default those stored with the scene, which may be none."""
    if cameras is None:
        return scene.cameras
    if kind_of(cameras) == "packed":
        return load(cameras).cameras
    if is_run(cameras):
        return open_run(cameras, max_cameras=most or VIEWS["cpu"]).cameras
    return cameras_of(cameras, scene)


def warn_if_few(count: int | None, total: int) -> None:
    """Say on stderr that a scene has fewer Gaussians than it should keep."""
    if count is not None and count > total:
        print(f"warning: the scene has {total:,} Gaussians, fewer than {count:,}; all are kept", file=sys.stderr)


def copies_rows(source: Path, out: Path) -> bool:
    """Whether a .ply keeps the rows, properties and comments of another one."""
    return kind_of(source) == "ply" and out.suffix.lower() == ".ply" and has_own_columns(source)
