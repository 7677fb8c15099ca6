"""Photos before camera poses are found: what a folder holds, by the contents of its files."""

from __future__ import annotations

import os
from pathlib import Path

from PIL import Image

from sundae_ns.data.capture import check_image
from sundae_ns.errors import DataError, reading, regular

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".cr2")
"""Photos that ns-process-data reads."""
LEAST_PHOTOS = 3
"""Number of photos with a pose that a scene needs, because nerfstudio holds out at least one for test."""
_KINDS = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png", "TIFF": ".tif"}
"""Suffix for a format of Pillow; phones write MPO, a JPEG of several images."""
_RAW = ".cr2"


def find_photos(folder: Path) -> tuple[list[Path], str]:
    """The photos in a folder and its subfolders, sorted by path, and the suffix that fits their contents.

    Hidden files and folders are left out, and so are files of other suffixes. Only headers are read.

    Raises:
        DataError: the folder cannot be read, holds fewer than :data:`LEAST_PHOTOS` photos, a file with the suffix of a
            photo that is none, or photos of several formats.
    """
    photos: dict[Path, str] = {}
    with reading(folder, "a folder of photos"):
        for place, folders, files in os.walk(folder, onerror=_raise):
            folders[:] = [name for name in folders if not name.startswith(".")]
            for name in files:
                path = Path(place, name)
                if not name.startswith(".") and path.suffix.lower() in SUFFIXES:
                    photos[path] = _suffix_of(path)
    paths = sorted(photos)
    if not paths:
        raise DataError(f"{folder} holds no photos ({', '.join(SUFFIXES)}); give a folder of photos, or a capture")
    if len(paths) < LEAST_PHOTOS:
        few = "1 photo" if len(paths) == 1 else f"{len(paths)} photos"
        raise DataError(f"{folder} holds {few}, and camera poses need {LEAST_PHOTOS} or more that overlap; add some")
    first = paths[0]
    other = next((path for path in paths if photos[path] != photos[first]), None)
    if other is not None:
        raise DataError(
            f"{first} is a {photos[first]} and {other} a {photos[other]} by its contents; save all photos in one format"
        )
    return paths, photos[first]


def _raise(error: OSError) -> None:
    raise error


def _suffix_of(path: Path) -> str:
    """Suffix for the contents of a photo; ``DataError`` if it is none."""
    if path.suffix.lower() == _RAW:
        with (
            reading(path, "a photo", mend="remove it", missing="repair or remove it"),
            regular(path).open("rb") as file,
        ):
            if file.read(10)[8:] != b"CR":
                raise DataError(f"{path} is not a raw photo of Canon; repair or remove it")
        return _RAW
    check_image(path)
    with Image.open(path) as image:
        found = str(image.format)
    if found not in _KINDS:
        raise DataError(f"{path} is a {found} file by its contents; save it as JPEG or PNG, or remove it")
    return _KINDS[found]
