"""Photos before camera poses are found: what a folder holds, by the contents of its files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from PIL import ExifTags, Image, ImageOps

from sundae_ns.data.capture import check_image, undecodable
from sundae_ns.errors import DataError, reading, regular

HEIF = (".heic", ".heif")
"""Photos of phones, for which Pillow needs the package pillow-heif."""
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", *HEIF, ".cr2")
"""Photos that are read."""
LEAST_PHOTOS = 3
"""Number of photos with a pose that a scene needs, because nerfstudio holds out at least one for test."""
AS_THEY_ARE = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png"}
"""Suffix for a format of Pillow that a capture may have; phones write MPO, a JPEG of several images."""
_CONVERTED = ("TIFF", "WEBP", "BMP", "HEIF")
"""Formats of Pillow whose photos are saved as JPEG, or as PNG if they have an alpha channel."""
RAW = ".cr2"
"""Raw photos of Canon, which Pillow does not read."""
_OTHERS = (".avif", ".jxl", ".dng", ".nef", ".arw", ".cr3", ".raf", ".orf", ".rw2", ".gif")
"""Photos of other formats, which are passed over."""
_CONVERT = "convert them to JPEG (`magick mogrify -format jpg FILES`, or export them as JPEG)"
MASKS = ("masks", "mask")
"""Names of folders whose images are masks, not photos."""


class Photo(NamedTuple):
    """A photo that can be used."""

    path: Path
    suffix: str
    """Of the image in a capture: ``.jpg`` or ``.png``."""
    size: tuple[int, int]
    """Width and height in pixels, upright; of a raw photo as it is stored, (0, 0)."""
    as_it_is: bool
    """Whether the file can be copied: its format is that of the suffix, and its pixels are upright."""
    lens: tuple[str, ...]
    """Camera, lens and focal length by EXIF; photos that share these and their size share a camera."""


def find_photos(folder: Path) -> list[Photo]:
    """The photos in a folder and its subfolders, sorted by path. Only headers are read.

    Hidden files and folders are left out, and so are folders of masks and files of other suffixes, which
    :func:`left_out` names.

    Raises:
        DataError: the folder cannot be read, has photos in several subfolders only, holds fewer than
            :data:`LEAST_PHOTOS` photos, or a file with the suffix of a photo that is none.
    """
    paths: list[Path] = []
    with reading(folder, "a folder of photos"):
        paths = sorted(path for path in _files(folder) if path.suffix.lower() in SUFFIXES)
    _check_one_scene(folder, paths)
    if not reads_heif():
        paths = [path for path in paths if path.suffix.lower() not in HEIF]
    photos = [photo_of(path) for path in paths]
    if not paths and (others := _passed_over(folder)):
        raise DataError(f"{folder} holds only photos that cannot be read ({_counted(others)}); {_mend(others)}")
    if not paths:
        raise DataError(f"{folder} holds no photos ({', '.join(SUFFIXES)}); give a folder of photos, or a capture")
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
    others = _passed_over(folder)
    if not others:
        return None
    return f"{_counted(others)} {'is' if sum(others.values()) == 1 else 'are'} left out; {_mend(others)}"


def masks_beside(folder: Path) -> Path | None:
    """The first folder of masks in a folder of photos; None without one."""
    for place, folders, _ in os.walk(folder):
        for name in sorted(folders):
            if name.lower() in MASKS:
                return Path(place, name)
    return None


def upright(photo: Photo) -> Image.Image:
    """The pixels of a photo as they are to be seen, with its EXIF data; ``DataError`` if they cannot be decoded."""
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
    """Files of a folder and its subfolders that are neither hidden nor masks."""
    for place, folders, files in os.walk(folder, onerror=_raise):
        folders[:] = [name for name in folders if not name.startswith(".") and name.lower() not in MASKS]
        yield from (Path(place, name) for name in files if not name.startswith("."))


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


def _passed_over(folder: Path) -> dict[str, int]:
    """Numbers of photos of formats that are passed over, by suffix."""
    unread = _OTHERS if reads_heif() else (*_OTHERS, *HEIF)
    suffixes = (path.suffix.lower() for path in _files(folder))
    return dict(Counter(suffix for suffix in suffixes if suffix in unread))


def _mend(others: dict[str, int]) -> str:
    return 'install pillow-heif with pip install "sundae_ns[photos]"' if set(others) <= set(HEIF) else _CONVERT


def _counted(counts: dict[str, int]) -> str:
    return " and ".join(f"{count} {suffix} file{'s' * (count > 1)}" for suffix, count in sorted(counts.items()))


def _raise(error: OSError) -> None:
    raise error


def photo_of(path: Path) -> Photo:
    """A photo, after a check of its header; ``DataError`` if the file is none, or of a format that is not read."""
    if path.suffix.lower() == RAW:
        with (
            reading(path, "a photo", mend="remove it", missing="repair or remove it"),
            regular(path).open("rb") as file,
        ):
            if file.read(10)[8:] != b"CR":
                raise DataError(f"{path} is not a raw photo of Canon; repair or remove it")
        return Photo(path, ".jpg", (0, 0), False, (RAW,))
    check_image(path)
    with Image.open(path) as image:
        found, size, alpha, exif = str(image.format), image.size, image.mode == "RGBA", image.getexif()
        stated = exif.get(ExifTags.Base.Orientation, 1)
        lens = _lens(exif)
    if found not in (*AS_THEY_ARE, *_CONVERTED):
        raise DataError(f"{path} is a {found} file by its contents; save it as JPEG or PNG, or remove it")
    turned = stated in range(2, 9)
    suffix = AS_THEY_ARE.get(found, ".png" if alpha else ".jpg")
    return Photo(path, suffix, size[::-1] if stated in range(5, 9) else size, found in AS_THEY_ARE and not turned, lens)


def _lens(exif: Image.Exif) -> tuple[str, ...]:
    """Maker, model, lens and focal length of a photo, as far as they are stated."""
    with suppress(Exception):  # a damaged entry is none
        inner = exif.get_ifd(ExifTags.IFD.Exif)
        named = [exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model), inner.get(ExifTags.Base.LensModel)]
        focal = inner.get(ExifTags.Base.FocalLength)
        return tuple(str(value).strip() for value in [*named, focal and f"{float(focal):.1f}"] if value)
    return ()
