"""Photos before camera poses are found: what a folder holds, by the contents of its files, their masks, and how they
are turned."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.data.capture import check_image, undecodable

HEIF = (".heic", ".heif")
"""Photos of phones, for which Pillow needs the package pillow-heif."""
RAW = ".cr2"
"""Raw photos of Canon, which Pillow does not read."""
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", *HEIF, RAW)
_OTHERS = (".avif", ".jxl", ".dng", ".nef", ".arw", ".cr3", ".raf", ".orf", ".rw2", ".gif")
"""Suffixes of photos that are not read."""
LEAST_PHOTOS = 3
"""Number of photos with a pose that a scene needs, because nerfstudio holds out at least one for test."""
TURNED = (5, 6, 7, 8)
"""EXIF orientations that swap width and height."""
_COPIED = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png"}
"""Suffix of photos in a capture by Pillow's format; phones write MPO, a JPEG of several images."""
_CONVERTED = ("TIFF", "WEBP", "BMP", "HEIF")
"""Formats of Pillow whose photos are saved as JPEG, or as PNG if they have an alpha channel."""
_MASKS = ("masks", "mask")
"""Names of folders whose images are masks."""


class Photo(NamedTuple):
    """A photo that can be used."""

    path: Path
    suffix: str
    """Of the image in a capture: ``.jpg`` or ``.png``."""
    size: tuple[int, int]
    """Width and height in pixels, upright; (0, 0) for a raw photo."""
    as_it_is: bool
    """Whether the file can be copied: its format is that of the suffix, and its pixels are upright."""
    lens: tuple[str, ...]
    """Camera, lens and focal length by EXIF; photos that share these and their size share a camera."""


def find_photos(folder: Path) -> list[Photo]:
    """The photos in a folder and its subfolders, sorted by path. Only headers are read.

    Hidden files and folders, folders of masks and files of other suffixes are left out.

    Raises:
        DataError: the folder cannot be read, has photos in several subfolders only, holds fewer than
            :data:`LEAST_PHOTOS` photos, or a file with the suffix of a photo that is none.
    """
    paths: list[Path] = []
    with reading(folder, "a folder of photos"):
        paths = sorted(path for path in _files(folder) if path.suffix.lower() in SUFFIXES)
    counts = Counter(path.parent for path in paths)
    if len(counts) > 1 and folder not in counts:
        listed = ", ".join(f"{path.relative_to(folder)}: {count:,}" for path, count in list(counts.items())[:3])
        raise DataError(
            f"{folder} holds {len(paths):,} photos in {len(counts)} folders ({listed}{', ...' * (len(counts) > 3)}); "
            "give the folder of one scene, or move the photos of one scene into one folder"
        )
    if not reads_heif():
        paths = [path for path in paths if path.suffix.lower() not in HEIF]
    if not paths and (remark := left_out(folder)):
        raise DataError(f"{folder} holds no photos that can be read: {remark}")
    if not paths:
        raise DataError(f"{folder} holds no photos ({', '.join(SUFFIXES)}); give a folder of photos, or a capture")
    photos = [photo_of(path) for path in paths]
    if len(paths) < LEAST_PHOTOS:
        few = "1 photo" if len(paths) == 1 else f"{len(paths)} photos"
        raise DataError(f"{folder} holds {few}, and camera poses need {LEAST_PHOTOS} or more that overlap; add some")
    return photos


@cache
def reads_heif() -> bool:
    """Whether pillow-heif is installed; then Pillow reads HEIC from now on."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


def left_out(folder: Path) -> str | None:
    """A remark on photos of other formats in a folder; None without any."""
    unread = _OTHERS if reads_heif() else (*_OTHERS, *HEIF)
    counts = Counter(suffix for path in _files(folder) if (suffix := path.suffix.lower()) in unread)
    if not counts:
        return None
    listed = " and ".join(f"{count} {suffix} file{'s' * (count > 1)}" for suffix, count in sorted(counts.items()))
    remedy = "convert them to JPEG (`magick mogrify -format jpg FILES`, or export them as JPEG)"
    if counts.keys() <= set(HEIF):
        remedy = 'install pillow-heif with pip install "sundae_ns[photos]"'
    return f"{listed} {'is' if counts.total() == 1 else 'are'} left out; {remedy}"


def masks_beside(folder: Path) -> Path | None:
    """The first folder of masks in a folder of photos; None without one."""
    found = (Path(parent, name) for parent, names, _ in os.walk(folder) for name in sorted(names))
    return next((path for path in found if path.name.lower() in _MASKS), None)


def upright(photo: Photo) -> Image.Image:
    """The upright pixels of a photo with its EXIF data; ``DataError`` if they cannot be decoded."""
    try:
        if photo.path.suffix.lower() == RAW:
            import rawpy  # comes with nerfstudio

            with rawpy.imread(str(photo.path)) as raw:
                return Image.fromarray(raw.postprocess())
        with Image.open(photo.path) as image:
            image.load()
            return ImageOps.exif_transpose(image)
    except Exception as error:  # decoders raise many kinds
        raise undecodable(photo.path, error) from error


def _files(folder: Path) -> Iterator[Path]:
    def fail(error: OSError) -> None:
        raise error

    for parent, folders, files in os.walk(folder, onerror=fail):
        folders[:] = [name for name in folders if not name.startswith(".") and name.lower() not in _MASKS]
        yield from (Path(parent, name) for name in files if not name.startswith("."))


def photo_of(path: Path) -> Photo:
    """A photo, after a check of its header; ``DataError`` if the file is none, or of a format that is not read."""
    if path.suffix.lower() == RAW:
        with (
            reading(path, "a photo", remedy="remove it", missing="repair or remove it"),
            regular(path).open("rb") as file,
        ):
            if file.read(10)[8:] != b"CR":
                raise DataError(f"{path} is not a raw photo of Canon; repair or remove it")
        return Photo(path, ".jpg", (0, 0), False, (RAW,))
    check_image(path)
    with Image.open(path) as image:
        kind, size, alpha, exif = str(image.format), image.size, image.mode == "RGBA", image.getexif()
        orientation = exif.get(ExifTags.Base.Orientation, 1)
        lens = _lens(exif)
    if kind not in (*_COPIED, *_CONVERTED):
        raise DataError(f"{path} is a {kind} file by its contents; save it as JPEG or PNG, or remove it")
    suffix = _COPIED.get(kind, ".png" if alpha else ".jpg")
    size = size[::-1] if orientation in TURNED else size
    return Photo(path, suffix, size, kind in _COPIED and orientation not in range(2, 9), lens)


def _lens(exif: Image.Exif) -> tuple[str, ...]:
    """Maker, model, lens and focal length of a photo, if they are stated."""
    with suppress(Exception):  # a damaged entry is none
        inner = exif.get_ifd(ExifTags.IFD.Exif)
        named = [exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model), inner.get(ExifTags.Base.LensModel)]
        focal = inner.get(ExifTags.Base.FocalLength)
        return tuple(str(value).strip() for value in [*named, focal and f"{float(focal):.1f}"] if value)
    return ()


def exif_orientation(path: Path) -> int:
    """EXIF orientation of an image, from 1 (as stored) to 8; 1 if it states none."""
    with suppress(Exception), Image.open(path) as image:  # decoders raise many kinds; a damaged entry is none
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        return orientation if orientation in range(1, 9) else 1
    return 1


def turn(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Turn stored pixels ``[H, W, C]`` upright by their EXIF orientation."""
    image = Image.fromarray(pixels)
    image.getexif()[ExifTags.Base.Orientation] = orientation
    return np.array(ImageOps.exif_transpose(image))


def wrong_size(path: Path, size: Sequence[int], expected: Sequence[int], orientation: int) -> DataError:
    """The error for an image whose size is not that of its camera."""
    remedy = "give each size its own camera, or resize the images"
    if orientation in TURNED:
        remedy = "it is also turned by its EXIF entry: turn its pixels and remove the entry"
    elif max(abs(a - b) for a, b in zip(size, expected, strict=True)) <= 1:
        remedy = "give colmap --downscale-rounding-mode round (or ceil), or make the smaller images again"
    (width, height), (stated_width, stated_height) = size, expected
    return DataError(
        f"{path.name} is {width} x {height} px but its camera says {stated_width} x {stated_height}; {remedy}"
    )


def masks_of(photos: Sequence[Photo], folder: Path) -> list[Path]:
    """The mask of each photo: an image in ``folder`` with the photo's name, or with ``.png`` behind it or in its place.

    Raises:
        DataError: a photo has no mask, or one of another size, or one that may be turned otherwise.
    """
    masks = []
    for path, _, wanted, _, _ in photos:
        names = (path.name, f"{path.name}.png", f"{path.stem}.png", f"{path.stem}.jpg")
        mask = next((folder / name for name in names if (folder / name).is_file()), None)
        if mask is None:
            raise DataError(f"{path} has no mask {path.stem}.png in {folder}; add it, white where pixels count")
        size, orientation = check_image(mask, mask=True), exif_orientation(path)
        # A mask of the upright size is upright; where both sizes are the same, nothing says so.
        known = orientation in TURNED and size == wanted and size != size[::-1]
        if orientation != 1 and not known:
            raise DataError(f"{path} is turned by its EXIF entry, and its mask is not; save both upright")
        if wanted not in (size, (0, 0)):
            raise DataError(f"{mask} has {size[0]} x {size[1]} px and its photo {wanted[0]} x {wanted[1]}; scale it")
        masks.append(mask)
    return masks
