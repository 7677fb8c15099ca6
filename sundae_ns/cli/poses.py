"""``sundae poses``: from photos or a video to a capture with camera poses, without a program of the system."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sundae_ns.cli.process import loading, quoted
from sundae_ns.errors import ConfigError, DataError, StorageError, SundaeError, one_line

if TYPE_CHECKING:
    from sundae_ns.poses import Found, Placed

Matching = Literal["auto", "exhaustive", "sequential", "similar"]
FRAMES = 150
"""Default number of frames of a video."""
_MOST_NAMES = 3


def poses(
    photos: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    matching: Matching = "auto",
    frames: int = FRAMES,
    masks: Path | None = None,
) -> int:
    """Find the camera poses of photos, and write a capture: images at several sizes, transforms.json, points, masks.

    The same command again continues an interrupted one. All processors are used, or as many as OMP_NUM_THREADS says.

    Args:
        photos: folder of photos, or a video.
        out: folder of the capture; it must not exist yet.
        matching: photos that are compared: all pairs, neighbours in time and similar ones (for a video), or similar
            ones; by default what suits their number.
        frames: number of frames of a video; the sharpest of each stretch.
        masks: folder with a mask for each photo, under its name; by default one named masks beside the photos.
    """
    masks = check_poses(photos, frames, masks)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StorageError(f"{out} exists; choose another folder, or remove it")
    if photos.is_dir() and out.resolve().is_relative_to(photos.resolve()):
        raise StorageError(f"{out} lies in {photos}, which the command reads; choose another folder")
    with loading():
        from sundae_ns.poses import Request
        from sundae_ns.poses.reconstruct import pycolmap

        pycolmap()
    request = Request(photos, out, matching, frames, masks)
    found = _interruptible(lambda: _find(request), request.work)
    _print(out, found)
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
    from sundae_ns.poses.reconstruct import check_installed
    from sundae_ns.poses.video import SUFFIXES, is_video, video_size

    check_installed()
    if not photos.exists():
        raise DataError(f"{photos} does not exist; give a folder of photos, or a video")
    if frames < LEAST_PHOTOS:
        raise ConfigError(f"frames is {frames}; give at least {LEAST_PHOTOS}")
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


def too_few(capture: Path, placed: Placed) -> DataError:
    """The error for a capture in which too few photos have a pose."""
    return DataError(
        f"COLMAP placed {len(placed.placed)} of {placed.total} photos; {placed.again}, and start in another folder, or "
        f"train on these with `sundae run {quoted(capture)} -o OTHER`"
    )


def _find(request: object) -> Found:
    from sundae_ns.poses import find_poses

    return find_poses(request, _report)  # type: ignore[arg-type]


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


def _interruptible(work: Callable[[], Found], folder: Path) -> Found:
    """Run in a thread: COLMAP's functions return to Python only after minutes, and an interrupt ends them at once."""
    found: list[Found] = []
    failed: list[BaseException] = []

    def run() -> None:
        try:
            found.append(work())
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(0.2)
    except KeyboardInterrupt:
        cursor = "\x1b[?25h\x1b[2K\r" if sys.stderr.isatty() else ""  # a bar hides it
        print(f"{cursor}sundae: interrupted; the same command continues here", file=sys.stderr, flush=True)
        os._exit(130)
    if not failed:
        return found[0]
    if isinstance(failed[0], (SundaeError, OSError)):
        raise failed[0]
    raise DataError(
        f"COLMAP failed ({one_line(failed[0])}); remove {quoted(folder)} and start again, or report it"
    ) from failed[0]


def _print(out: Path, found: Found) -> None:
    photos = found.photos
    cameras = "1 camera" if found.cameras == 1 else f"{found.cameras} cameras"
    print(
        f"{out}: {len(photos.placed):,} of {photos.total:,} photos have a pose, of {cameras}; mean reprojection error "
        f"{found.error:.2f} px"
    )
    if len(found.models) > 1:
        others = ", ".join(f"{count:,}" for count in found.models[1:])
        print(f"# this is the largest of {len(found.models)} models that do not join; others have {others} photos")
    if found.masks is not None:
        print(f"# masks: {found.masks}")
    if photos.left_out:
        shown = ", ".join(photos.left_out[:_MOST_NAMES]) + (", ..." if len(photos.left_out) > _MOST_NAMES else "")
        mark = "" if photos.enough else "warning: "
        print(f"# {mark}without a pose: {shown}; to add them, {photos.again}", flush=True)
