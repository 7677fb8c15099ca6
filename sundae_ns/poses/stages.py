"""From photos or a video to a capture, in stages: frames, images, features, matches, poses, capture.

All is made in a folder beside the capture, which is renamed at the end. A killed command continues there.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from sundae_ns.data.masks import add_masks, masks_of
from sundae_ns.data.photos import Photo, find_photos
from sundae_ns.errors import writing
from sundae_ns.poses import pairs, reconstruction
from sundae_ns.poses.capture import TRANSFORMS, Placed, placed_in, write_capture
from sundae_ns.poses.images import names_of, write_images
from sundae_ns.poses.pairs import Matching
from sundae_ns.poses.reconstruction import Advance, Model
from sundae_ns.poses.video import is_video, write_frames
from sundae_ns.storage.atomic import flush, write_text
from sundae_ns.storage.run_folder import reserve

_REQUEST = "request.json"
_BUSY = "works in {}; wait for it, or choose another folder"


@dataclass(frozen=True)
class Request:
    """What is asked for."""

    photos: Path
    """Folder of photos, or a video."""
    capture: Path
    """Folder to make."""
    matching: Matching
    frames: int
    """Number of frames of a video."""
    masks: Path | None
    """Folder of masks, one for each photo."""

    @property
    def work(self) -> Path:
        """Folder in which the capture is made."""
        return self.capture.with_name(f"{self.capture.name}.partial")


@dataclass(frozen=True)
class Found:
    """What has been found."""

    photos: Placed
    cameras: int
    error: float
    """Mean reprojection error, pixels."""
    models: tuple[int, ...]
    """Numbers of photos of COLMAP's models, the largest first; it is the capture."""
    masks: str | None
    """How many frames have a mask, ``24 of 24``; None without masks."""


class Reporter(Protocol):
    """Shows the progress of a stage."""

    def __call__(self, stage: str, total: int) -> AbstractContextManager[Advance]:
        """Begin a stage of ``total`` parts; the value is called with the number of further parts."""
        ...


def find_poses(request: Request, report: Reporter) -> Found:
    """Make a capture; what an earlier process has done with the same photos and options is used.

    Raises:
        DataError: photos cannot be used, or none could be placed.
        StorageError: another process works on it, or the disk is full or not writable.
    """
    work = request.work
    with writing(f"cannot make {work}"):
        reserve(work, _BUSY)
        given = [] if is_video(request.photos) else find_photos(request.photos)
        _take_up(request, given)
        photos = given or _frames(request, report)
        names = names_of(photos)
        images = work / "images"
        with report("images", len(photos)) as advance:
            write_images(photos, images, advance)
        models = _models(request, names, report)
        found = models[0]
        made, sources = work / "capture", {name: photo.path.name for name, photo in zip(names, photos, strict=True)}
        with report("capture", len(found.images)) as advance:
            write_capture(made, found.folder, images, sources, advance)
            masks = None if request.masks is None else add_masks(made, masks_of(photos, request.masks))
        flush(made / TRANSFORMS)  # written last; the system has written the other files meanwhile
        made.replace(request.capture)
        shutil.rmtree(work, ignore_errors=True)
    cameras = len({Path(name).parent for name in found.images})
    return Found(placed_in(request.capture), cameras, found.error, tuple(len(model.images) for model in models), masks)


def _models(request: Request, names: Sequence[str], report: Reporter) -> list[Model]:
    work, images = request.work, request.work / "images"
    reconstruction.make_database(work, images, names)
    with report("features", len(names)) as advance:
        reconstruction.find_features(work, images, names, advance)
    if not (work / reconstruction.MODELS).exists():
        way = pairs.chosen(request.matching, len(names), is_video(request.photos))
        if way == "exhaustive":
            compared = pairs.exhaustive(len(names))
        else:
            similarity = pairs.similarities(reconstruction.read_descriptors(work, names))
            compared = pairs.sequential(similarity) if way == "sequential" else pairs.similar(similarity)
        with report("matches of pairs", len(compared)) as advance:
            reconstruction.match(work, names, compared, advance)
    with report("poses", len(names)) as advance:
        return reconstruction.reconstruct(work, images, len(names), advance)


def _frames(request: Request, report: Reporter) -> list[Photo]:
    frames = request.work / "frames"
    if not frames.exists():
        with report("frames", request.frames) as advance:
            write_frames(request.photos, frames, request.frames, advance)
    return find_photos(frames)


def _take_up(request: Request, photos: Sequence[Photo]) -> None:
    """Keep what the folder holds if it was made of the same photos with the same options; remove it otherwise."""
    asked = json.dumps(_described(request, photos), indent=1) + "\n"
    path = request.work / _REQUEST
    if path.is_file() and path.read_text(encoding="utf-8", errors="replace") == asked:
        return
    for entry in request.work.iterdir():
        if entry.is_dir():
            shutil.rmtree(entry)
        elif entry.suffix != ".lock":
            entry.unlink()
    write_text(path, asked)


def _described(request: Request, photos: Sequence[Photo]) -> dict[str, object]:
    """The options, and each photo, or the video, with its size and time."""
    video = is_video(request.photos)
    files = [request.photos] if video else [photo.path for photo in photos]
    times = [(str(path.absolute()), path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return {"matching": request.matching, "frames": request.frames if video else 0, "files": times}
