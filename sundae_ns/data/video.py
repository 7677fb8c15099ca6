"""Frames of a video: the sharpest of each stretch."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sundae_ns.core.errors import DataError, regular, writing
from sundae_ns.data.photos import LEAST_PHOTOS

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".3gp")


def is_video(path: Path) -> bool:
    """Whether a path is a file with the suffix of a video."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


def check_video(path: Path) -> None:
    """Raise ``DataError`` if a video cannot be decoded, or has too few frames."""
    with _opened(path) as video:
        length = _length(video, path)
        if not video.grab():
            raise DataError(f"{path} has no frame that can be decoded; convert it to .mp4 (H.264)")
    if length < LEAST_PHOTOS:
        raise DataError(f"{path} has {length} frames, and camera poses need {LEAST_PHOTOS} or more; give a longer one")


def write_frames(path: Path, folder: Path, count: int, advance: Callable[[int], None]) -> None:
    """Write the sharpest frame of each of ``count`` stretches of a video, as ``00001.jpg`` and so on.

    Args:
        path: the video.
        folder: for the frames; it appears once all are written.
        count: number of frames; a shorter video gives all of its own.
        advance: called with the number of further frames.

    Raises:
        DataError: the video cannot be decoded.
        StorageError: the disk is full or not writable.
    """
    import cv2

    partial = folder.with_name(f"{folder.name}.partial")
    with writing(f"cannot write {folder}"):
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        with _opened(path) as video:
            written = 0
            for frame in _sharpest(video, _length(video, path), count):
                written += 1
                encoded, content = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 97])
                if not encoded:
                    raise DataError(f"frame {written} of {path} cannot be saved as JPEG; make the video smaller")
                (partial / f"{written:05d}.jpg").write_bytes(content.tobytes())
                advance(1)
        if written < LEAST_PHOTOS:
            raise DataError(f"{path} ends after {written} frames that can be decoded; convert it to .mp4 (H.264)")
        partial.replace(folder)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        regular(path)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); check the path") from error
    # Our error says what is wrong; OpenCV reads both variables when it is imported first.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    import cv2

    video = cv2.VideoCapture(str(path.absolute()))
    try:
        if not video.isOpened():
            raise DataError(f"{path} is not a video that OpenCV decodes; convert it to .mp4 (H.264)")
        yield video
    finally:
        video.release()


def _length(video: Any, path: Path) -> int:
    """Number of frames: as the file states, or counted."""
    import cv2

    stated = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    if stated > 0:
        return stated
    with _opened(path) as other:
        return sum(1 for _ in iter(other.grab, False))


def _sharpest(video: Any, length: int, count: int) -> Iterator[np.ndarray]:
    """The sharpest of 12 frames ``[H, W, 3]`` of each of ``count`` equal stretches of a video of ``length`` frames."""
    count = min(count, length)
    every = max(1, length // (count * 12))
    best: tuple[float, np.ndarray] | None = None
    number = stretch = 0
    while video.grab():
        # A file may hold more frames than it states; they belong to the last stretch.
        current = min(number * count // length, count - 1)
        if current != stretch:
            if best is not None:
                yield best[1]
            stretch, best = current, None
        if best is None or number % every == 0:
            decoded, frame = video.retrieve()
            if decoded and (best is None or sharpness(frame) > best[0]):
                best = sharpness(frame), frame
        number += 1
    if best is not None:
        yield best[1]


def sharpness(frame: np.ndarray) -> float:
    """Variance of the Laplacian of a frame ``[H, W, 3]`` uint8, at a width of at most 960 pixels."""
    import cv2

    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    if grey.shape[1] > 960:
        size = 960, max(1, grey.shape[0] * 960 // grey.shape[1])
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())
