"""``sundae poses``: from photos or a video to a capture with camera poses, without a program of the system."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from sundae_ns.cli.main import STEP
from sundae_ns.cli.options import File, Input, Out, Plain, progress_bar, word
from sundae_ns.cli.refusals import check_folder, check_least
from sundae_ns.core.errors import ConfigError, DataError, SundaeError, one_line
from sundae_ns.data import reconstruct
from sundae_ns.data.capture_files import Placed
from sundae_ns.data.photos import LEAST_PHOTOS, find_photos, masks_beside, masks_of
from sundae_ns.data.video import SUFFIXES, check_video, is_video

_warn = partial(print, "# warning:", flush=True)


@dataclass(frozen=True)
class PoseOptions:
    """How poses are found."""

    matching: Literal["auto", "exhaustive", "sequential", "similar"] = "auto"
    """photos that are compared: all, neighbours in time and similar ones, or similar ones; auto goes by the number."""
    frames: int = 150  # number of frames of a video; the sharpest of each stretch
    masks: File = None
    """folder with a mask for each photo, under its name: training leaves out what is black; by default PATH/masks."""


def poses(photos: Input, out: Out, options: Plain[PoseOptions] = PoseOptions()) -> int:  # noqa: B008
    """Find the camera poses of photos, and write a capture: images at several sizes, transforms.json, points, masks.

    The same command again continues an interrupted one. All processors are used, or as many as OMP_NUM_THREADS says.

    Args:
        photos: folder of photos, or a video.
        out: folder of the capture; it must not exist yet.
    """
    masks = check_poses(photos, options)
    check_folder(out, reads=[], outside=photos)
    request = reconstruct.Request(photos, out, options.matching, options.frames, masks)
    placed = _interruptible(lambda: reconstruct.find_poses(request, _report, _warn), request.work)
    counts = f"{len(placed.placed):,} of {placed.total:,} photos have a pose, of {placed.cameras} camera"
    masked = "" if masks is None else f"; masks are those of {masks}"
    print(f"{out}: {counts}{'s' * (placed.cameras > 1)}; mean reprojection error {placed.error:.2f} px{masked}")
    if placed.left_out and (others := ", ".join(f"{count:,}" for count in placed.models[1:])):
        print(f"# this is the largest of {len(placed.models)} models that do not join; others have {others} photos")
    if placed.left_out:
        names = ", ".join(placed.left_out[:3]) + (", ..." if len(placed.left_out) > 3 else "")
        warning = "" if placed.enough else "warning: "
        print(f"# {warning}without a pose: {names}; to add them, {placed.again}", flush=True)
    return 0


def check_poses(photos: Path, options: PoseOptions, *, remarks: bool = True) -> Path | None:
    """Check photos or a video by headers, print ``remarks``; the folder of masks, by default one beside the photos."""
    reconstruct.pycolmap()
    check_least(frames=(options.frames, LEAST_PHOTOS))
    warn: Callable[[str], object] = _warn if remarks else str
    if is_video(photos):
        if options.masks is not None:
            raise ConfigError("a video has no masks; leave out --masks")
        check_video(photos, warn)
        return None
    if photos.exists() and not photos.is_dir():
        raise DataError(f"{photos} is neither a folder nor a video ({', '.join(SUFFIXES)}); give the folder of photos")
    files = find_photos(photos, warn)
    masks = options.masks or masks_beside(photos)
    try:
        if masks is not None:
            masks_of(files, masks)
    except DataError as error:
        if options.masks is not None:
            raise
        warn(f"{masks} is left out: {error}")
        return None
    return masks


@contextmanager
def _report(stage: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar on a terminal while a stage runs, and a line at its end."""
    begun = time.monotonic()
    with progress_bar() as bar:
        yield partial(bar.advance, bar.add_task(stage, total=total))
        done = min(int(bar.tasks[0].completed), total)
    print(f"{stage}: {done:,} of {total:,}, {time.monotonic() - begun:.0f} s", flush=True)


def _interruptible(work: Callable[[], Placed], folder: Path) -> Placed:
    """Run in a thread: COLMAP's functions return to Python only after minutes, and an interrupt ends them at once."""
    with ThreadPoolExecutor(1) as threads:
        try:
            return threads.submit(work).result()
        except (SundaeError, OSError):
            raise
        except (KeyboardInterrupt, SystemExit) as stop:
            cursor = "\x1b[?25h\x1b[2K\r" if sys.stderr.isatty() else ""  # a bar hides it
            message = "" if os.environ.get(STEP) else "sundae: interrupted; the same command continues here\n"
            print(f"{cursor}{message}", end="", file=sys.stderr, flush=True)
            os._exit(getattr(stop, "code", 130))
        except Exception as error:  # COLMAP raises many kinds
            remedy = f"remove {shlex.quote(word(folder))} and start again, or report it"
            raise DataError(f"COLMAP failed ({one_line(error)}); {remedy}") from error
