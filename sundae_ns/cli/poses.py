"""``sundae poses``: from photos or a video to a capture with camera poses, without a program of the system."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import tyro

from sundae_ns.cli.options import Out, Source, check_least
from sundae_ns.cli.process import quoted, word
from sundae_ns.core.errors import ConfigError, DataError, StorageError, SundaeError, one_line

T = TypeVar("T")


@dataclass(frozen=True)
class PoseOptions:
    """How poses are found."""

    matching: Literal["auto", "exhaustive", "sequential", "similar"] = "auto"
    """photos that are compared: all pairs, neighbours in time and similar ones (for a video), or similar ones; by
    default what suits their number."""
    frames: int = 150
    """number of frames of a video; the sharpest of each stretch."""
    masks: Path | None = None
    """folder with a mask for each photo, under its name; training leaves out what is black. By default one named masks
    beside the photos."""

    def words(self) -> list[str]:
        """Words of the command for what is not the default."""
        usual = PoseOptions()
        given = {name: value for name, value in vars(self).items() if value != getattr(usual, name)}
        return [text for name, value in given.items() for text in (f"--{name}", word(Path(str(value))))]


def poses(
    photos: Source,
    out: Out,
    options: Annotated[PoseOptions, tyro.conf.arg(name="")] = PoseOptions(),  # noqa: B008
) -> int:
    """Find the camera poses of photos, and write a capture: images at several sizes, transforms.json, points, masks.

    The same command again continues an interrupted one. All processors are used, or as many as OMP_NUM_THREADS says.

    Args:
        photos: folder of photos, or a video.
        out: folder of the capture; it must not exist yet.
    """
    masks = check_poses(photos, options.frames, options.masks)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StorageError(f"{out} exists; choose another folder, or remove it")
    if photos.is_dir() and out.resolve().is_relative_to(photos.resolve()):
        raise StorageError(f"{out} lies in {photos}, which the command reads; choose another folder")
    from sundae_ns.data.reconstruct import Request, find_poses, pycolmap

    pycolmap()
    request = Request(photos, out, options.matching, options.frames, masks)
    found = _interruptible(lambda: find_poses(request, _report), request.work)
    placed = found.photos
    cameras = "1 camera" if found.cameras == 1 else f"{found.cameras} cameras"
    print(
        f"{out}: {len(placed.placed):,} of {placed.total:,} photos have a pose, of {cameras}; mean reprojection error "
        f"{found.error:.2f} px"
    )
    if len(found.models) > 1:
        others = ", ".join(f"{count:,}" for count in found.models[1:])
        print(f"# this is the largest of {len(found.models)} models that do not join; others have {others} photos")
    if found.masks is not None:
        print(f"# masks: {found.masks}")
    if placed.left_out:
        names = ", ".join([*placed.left_out[:3], *(["..."] if len(placed.left_out) > 3 else [])])
        mark = "" if placed.enough else "warning: "
        print(f"# {mark}without a pose: {names}; to add them, {placed.again}", flush=True)
    return 0


def check_poses(photos: Path, frames: int, masks: Path | None, *, remarks: bool = True) -> Path | None:
    """Check photos or a video, by headers, before anything starts; ``remarks`` prints what is left out.

    Returns:
        The folder of masks: the given one, with ``remarks`` else one beside the photos that fits them; None without.

    Raises:
        ConfigError: pycolmap is not installed, a number is out of range, or masks are given for a video.
        DataError: the photos or masks cannot be used.
    """
    from sundae_ns.data.photos import LEAST_PHOTOS, find_photos, left_out, masks_beside, masks_of
    from sundae_ns.data.reconstruct import check_installed
    from sundae_ns.data.video import SUFFIXES, is_video, video_size

    check_installed()
    if not photos.exists():
        raise DataError(f"{photos} does not exist; give a folder of photos, or a video")
    check_least(frames=(frames, LEAST_PHOTOS))
    if masks is not None and not masks.is_dir():
        raise DataError(f"{masks} is no folder of masks; give one with an image for each photo")
    if is_video(photos):
        if masks is not None:
            raise ConfigError("a video has no masks; leave out --masks")
        video_size(photos)
        return None
    if photos.is_file():
        raise DataError(f"{photos} is neither a folder of photos nor a video ({', '.join(SUFFIXES)})")
    found = find_photos(photos)
    if masks is not None:
        masks_of(found, masks)
    if not remarks:
        return masks
    said = [left_out(photos)]
    if masks is None and (beside := masks_beside(photos)) is not None:
        try:
            masks_of(found, beside)
            masks = beside
        except DataError as error:
            said.append(f"{beside} is left out: {error}")
    for remark in filter(None, said):
        print(f"# warning: {remark}", flush=True)
    return masks


@contextmanager
def _report(stage: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar on a terminal while a stage runs, and a line at its end."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console, begun, done = Console(), time.monotonic(), 0
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(stage, total=total)

        def advance(count: int) -> None:
            nonlocal done
            done = min(done + count, total)
            bar.update(task, completed=done)

        yield advance
    print(f"{stage}: {done:,} of {total:,}, {time.monotonic() - begun:.0f} s", flush=True)


def _interruptible(work: Callable[[], T], folder: Path) -> T:
    """Run in a thread: COLMAP's functions return to Python only after minutes, and an interrupt ends them at once."""
    results: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(0.2)
    except KeyboardInterrupt:
        cursor = "\x1b[?25h\x1b[2K\r" if sys.stderr.isatty() else ""  # a bar hides it
        print(f"{cursor}sundae: interrupted; the same command continues here", file=sys.stderr, flush=True)
        os._exit(130)
    if results:
        return results[0]
    if isinstance(errors[0], (SundaeError, OSError)):
        raise errors[0]
    cause = one_line(errors[0])
    raise DataError(f"COLMAP failed ({cause}); remove {quoted(folder)} and start again, or report it") from errors[0]
