"""Photos before camera poses are found: what a folder holds, by the contents of its files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
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
_OTHERS = (".heic", ".heif", ".avif", ".webp", ".bmp", ".jxl", ".dng", ".nef", ".arw", ".cr3", ".raf", ".orf", ".rw2")
"""Photos of other formats, which ns-process-data passes over."""
_CONVERT = "convert them to JPEG (`magick mogrify -format jpg FILES`, or export them as JPEG)"
MASKS = ("masks", "mask")
"""Names of folders whose images are masks, not photos."""


def find_photos(folder: Path) -> tuple[list[Path], str]:
    """The photos in a folder and its subfolders, sorted by path, and the suffix that fits their contents.

    Hidden files and folders are left out, and so are folders of masks and files of other suffixes, which
    :func:`left_out` names. Only headers are read.

    Raises:
        DataError: the folder cannot be read, has photos in several subfolders only, holds fewer than
            :data:`LEAST_PHOTOS` photos, a file with the suffix of a photo that is none, or photos of several formats.
    """
    paths: list[Path] = []
    with reading(folder, "a folder of photos"):
        for place, folders, files in os.walk(folder, onerror=_raise):
            folders[:] = [name for name in folders if not name.startswith(".") and name.lower() not in MASKS]
            for name in files:
                path = Path(place, name)
                if not name.startswith(".") and path.suffix.lower() in SUFFIXES:
                    paths.append(path)
    paths.sort()
    _check_one_scene(folder, paths)
    photos = {path: _suffix_of(path) for path in paths}
    if not paths and (others := _other_formats(folder)):
        raise DataError(f"{folder} holds only photos that cannot be read ({_counted(others)}); {_CONVERT}")
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


def _check_one_scene(folder: Path, photos: Sequence[Path]) -> None:
    """Raise ``DataError`` for photos that lie in several subfolders only, which are probably several scenes."""
    counts = Counter(path.parent for path in photos)
    if len(counts) < 2 or folder in counts:
        return
    shown = ", ".join(f"{place.relative_to(folder)}: {count:,}" for place, count in list(counts.items())[:3])
    shown += ", ..." if len(counts) > 3 else ""
    raise DataError(
        f"{folder} holds {len(photos):,} photos in {len(counts)} folders ({shown}); "
        "give the folder of one scene, or move the photos of one scene into one folder"
    )


def left_out(folder: Path, photos: Sequence[Path], *, masked: bool = False) -> list[str]:
    """Remarks on photos that no scene is made of, one each: of other formats, of an odd size, and masks.

    Args:
        folder: of the photos.
        photos: from :func:`find_photos`.
        masked: whether masks are given.
    """
    remarks = []
    if others := _other_formats(folder):
        verb = "is" if sum(others.values()) == 1 else "are"
        remarks.append(f"{_counted(others)} {verb} left out, as only {', '.join(SUFFIXES)} are read; {_CONVERT}")
    sizes: dict[tuple[int, int], list[Path]] = {}
    for path in photos:
        if path.suffix.lower() != _RAW:
            sizes.setdefault(check_image(path), []).append(path)
    if len(sizes) > 1:
        usual = max(sizes, key=lambda size: len(sizes[size]))
        odd = sorted(path for size, paths in sizes.items() if size != usual for path in paths)
        shown = ", ".join(path.name for path in odd[:3]) + (", ..." if len(odd) > 3 else "")
        remarks.append(
            f"{len(odd)} of {len(photos)} photos ({shown}) are not {usual[0]} x {usual[1]} px as the others. COLMAP "
            "leaves them out, as it estimates one camera for all; crop or scale them to this size"
        )
    for place, folders, _ in os.walk(folder):
        for name in sorted(folders):
            if name.lower() in MASKS and not masked:
                remarks.append(
                    f"{Path(place, name)} is left out, as masks are not used for camera poses; to leave out what they "
                    "hide in training, give --masks, or each frame of transforms.json its mask_path"
                )
    return remarks


def _other_formats(folder: Path) -> dict[str, int]:
    """Numbers of photos of formats that are passed over, by suffix."""
    counts: dict[str, int] = {}
    for _, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            suffix = Path(name).suffix.lower()
            if suffix in _OTHERS and not name.startswith("."):
                counts[suffix] = counts.get(suffix, 0) + 1
    return counts


def _counted(counts: dict[str, int]) -> str:
    return " and ".join(f"{count} {suffix} file{'s' * (count > 1)}" for suffix, count in sorted(counts.items()))


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
