"""Photos before camera poses are found: what a folder holds, by the contents of its files, and their masks."""

from __future__ import annotations

import filecmp
import importlib
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import ExifTags, Image

from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.data import images
from sundae_ns.data.layouts import LONGEST_SIDE
from sundae_ns.data.lenses import kind_of_model

RAW = ".cr2"  # of Canon, which Pillow does not read
SUFFIXES = (".jpg", ".jpeg", ".jfif", ".jpe", ".png", ".tif", ".tiff", ".webp", ".bmp", *images.HEIF, RAW)
_OTHERS = tuple(".avif .jxl .jp2 .dng .nef .nrw .arw .cr3 .raf .orf .rw2 .pef .srw .exr .gif".split())  # are not read
LEAST_PHOTOS = 3  # with a pose that a scene needs, because nerfstudio holds out at least one for test
# Suffix in a capture by Pillow's format (phones write MPO, several JPEG images); others become JPEG, with alpha PNG.
_COPIED = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png"}
_CONVERTED = ("TIFF", "WEBP", "BMP", "HEIF")
_MASKS = ("masks", "mask")  # folders whose images are masks, by names as of RealityScan, Metashape, COLMAP
_MAP = re.compile(r"(?i)(?:.*[\W_])?(?:mask|depth|conf|confidence|normals?)(?:[\W_].*|\d*)")  # of maps of photos
_MASK_NAMES = ("{0.name}.mask.png", "{0.stem}_mask.png", "{0.name}", "{0.name}.png", "{0.stem}.png", "{0.stem}.jpg")
Warn = Callable[[str], object]  # called with a remark in one line


class Photo(NamedTuple):
    """A photo that can be used."""

    path: Path
    suffix: str  # of the image in a capture: .jpg or .png
    size: tuple[int, int]  # width and height in pixels, upright
    as_it_is: bool  # whether the file is upright, in sRGB and of the format of the suffix, so that it can be copied
    lens: tuple[str, ...]  # camera, lens and focal length by EXIF: with the size, what tells cameras apart


def find_photos(folder: Path, warn: Warn = str) -> list[Photo]:
    """The photos in a folder and its subfolders, sorted by path, judged by their headers.

    Hidden files and folders and those of masks are left out, and, with a line to ``warn``, photos that are not read.
    """
    with reading(folder, "a folder of photos"):
        suffixes = [suffix for suffix in SUFFIXES if suffix not in images.HEIF or images.reads_heif()]
        paths = sorted(path for path in _files(folder) if path.suffix.lower() in suffixes)
    if len(counts := Counter(path.parent for path in paths)) > 1 and folder not in counts:
        listed = ", ".join(f"{path.relative_to(folder)}: {count:,}" for path, count in list(counts.items())[:3])
        where = f"{folder} holds {len(paths):,} photos in {len(counts)} folders ({listed}{', ...' * (len(counts) > 3)})"
        raise DataError(f"{where}; give the folder of one scene, or move its photos into one folder")
    if len(paths) < LEAST_PHOTOS:
        few = f"{len(paths) or 'no'} photo{'s' * (len(paths) != 1)}, and camera poses need {LEAST_PHOTOS} or more"
        none = f"give a folder that holds some ({', '.join(suffixes)}), or a video by its own path"
        raise DataError(f"{folder} holds {few}; {left_out(folder) or ('add some that overlap' if paths else none)}")
    photos = list(usable(paths, photo_of, warn))
    if others := left_out(folder):
        warn(others)
    named = {path.with_suffix(""): path for path in reversed(paths)}  # RAW files and HEIC lie beside their JPEG
    twins = copies(photo.path for photo in photos)
    twins |= {path: first for path in paths if (first := named[path.with_suffix("")]) != path}
    for copy, first in [*twins.items()][:1]:
        warn(f"{copy} and {first} seem to be one photo ({len(twins)} pairs); remove one, or test views are trained on")
    return photos


def copies(paths: Iterable[Path]) -> dict[Path, Path]:
    """Files with the same bytes as an earlier one, which is the value."""
    middles = {path: np.fromfile(path, np.uint8, 4096, offset=path.stat().st_size // 2).tobytes() for path in paths}
    ordered = sorted(middles, key=middles.__getitem__)
    return {copy: path for path, copy in pairwise(ordered) if filecmp.cmp(path, copy, shallow=False)}


def usable(items: Sequence[Any], use: Callable[[Any], Any], warn: Warn) -> Iterator[Any]:
    """Results of ``use``, without up to half and 100 that raise a ``DataError``."""
    errors = 0
    for item in items:
        try:
            yield use(item)
        except DataError as error:
            errors += 1
            if errors > 100 or len(items) - errors < max(LEAST_PHOTOS, len(items) / 2):
                raise DataError(f"{error}; {errors} of {len(items):,} photos cannot be used") from error
            warn(f"left out: {error}")


def left_out(folder: Path) -> str | None:
    """A remark on photos of other formats in a folder; None without any."""
    unread = _OTHERS if images.reads_heif() else (*_OTHERS, *images.HEIF)
    if not (counts := Counter(suffix for path in _files(folder) if (suffix := path.suffix.lower()) in unread)):
        return None
    listed = ", ".join(f"{count} {suffix}" for suffix, count in sorted(counts.items()))
    convert = "convert them to JPEG (`magick mogrify -format jpg FILES`, or export them as JPEG)"
    install = 'install pillow-heif with pip install "sundae_ns[photos]"'
    return f"{listed} left out; {install if counts.keys() <= set(images.HEIF) else convert}"


def masks_beside(folder: Path) -> Path | None:
    """The first folder of masks in a folder of photos; None without one."""
    paths = (Path(parent, name) for parent, names, _ in os.walk(folder) for name in sorted(names))
    return next((path for path in paths if path.name.lower() in _MASKS), None)


def upright(photo: Photo) -> tuple[Image.Image, Image.Exif]:
    """The upright pixels of a photo in sRGB, and its EXIF data; ``DataError`` if they are broken."""
    with reading(photo.path, "a photo that can be decoded", remedy=images.REPAIR, missing=images.REPAIR):
        if photo.path.suffix.lower() == RAW:
            with _opened_raw(photo.path) as raw:
                return Image.fromarray(raw.postprocess()), Image.Exif()
        with images.opened(photo.path) as image:
            image.load()
            exif = image.getexif()
            pixels = images.turned(images.to_srgb(image), images.orientation_in(image))
        exif.pop(ExifTags.Base.Orientation, None)
        for name in (ExifTags.IFD.Interop, ExifTags.Base.ColorSpace):  # which may say Adobe RGB
            exif.get_ifd(ExifTags.IFD.Exif).pop(name, None)
    return pixels, exif


def _files(folder: Path) -> Iterator[Path]:
    def fail(error: OSError) -> None:
        raise error

    for parent, folders, files in os.walk(folder, onerror=fail):
        folders[:] = [name for name in folders if not name.startswith(".") and name.lower() not in _MASKS]
        yield from (Path(parent, name) for name in files if not name.startswith("."))


def photo_of(path: Path) -> Photo:
    """A photo, after a check of its header; ``DataError`` if the file is none, or of a format that is not read."""
    with reading(path, "a photo", remedy=images.REPAIR, missing=images.REPAIR):
        if path.suffix.lower() == RAW:
            with _opened_raw(path) as raw:
                size = raw.sizes.iwidth, raw.sizes.iheight
                return Photo(path, ".jpg", size[::-1] if raw.sizes.flip in (5, 6) else size, False, (RAW,))
        size = images.check_image(path)
        with images.opened(path) as image:
            kind = str(image.format)
            if image.mode in ("1", "L", "P", "I;16") and _MAP.fullmatch(path.stem):
                raise DataError(f"{path} is a mask or another map by its name; move masks into a folder {_MASKS[0]}")
            suffix = _COPIED.get(kind, ".png" if image.has_transparency_data else ".jpg")
            orientation = images.orientation_in(image)
            as_it_is = kind in _COPIED and orientation == 1 and images.is_srgb(image)
            lens = _lens(image.getexif())
            text = f"{image.info.get('xmp')} {lens}".upper()
            kind_of_model(next((key for key in ("EQUIRECTANGULAR", "CYLINDRICAL") if key in text), "OPENCV"), str(path))
    if kind not in (*_COPIED, *_CONVERTED):
        raise DataError(f"{path} is a {kind} file by its contents; save it as JPEG or PNG, or remove it")
    check_shape(path, size)
    return Photo(path, suffix, size[::-1] if orientation in images.TURNED else size, as_it_is, lens)


def _opened_raw(path: Path) -> Any:
    return importlib.import_module("rawpy").imread(str(regular(path)))  # comes with nerfstudio


def check_shape(path: Path, size: tuple[int, int]) -> None:
    """Raise ``DataError`` if an image has less than 8 pixels on a side at the size that COLMAP looks at."""
    if min(size) * min(1, LONGEST_SIDE / max(size)) < 8:
        raise DataError(f"{path} is {size[0]} x {size[1]} px, too narrow for camera poses; crop it, or remove it")


def _lens(exif: Image.Exif) -> tuple[str, ...]:
    """Maker, model, lens and focal length of a photo, if they are stated, and whether it is an iPhone's panorama."""
    with suppress(Exception):  # a damaged entry is none
        inner, base = exif.get_ifd(ExifTags.IFD.Exif), ExifTags.Base
        focal = f"{float(inner.get(base.FocalLength, 0)):.1f}" + " cylindrical" * (inner.get(base.CustomRendered) == 6)
        return str(exif.get(base.Make)), str(exif.get(base.Model)), str(inner.get(base.LensModel)), focal
    return ()


def masks_of(photos: Sequence[Photo], folder: Path) -> list[Path]:
    """The mask of each photo, by its name, in ``folder``, the same subfolder there, or a folder so named beside it."""
    root = Path(os.path.commonpath([photo.path.parent for photo in photos]))
    masks: list[Path] = []
    for path, _, wanted, _, _ in photos:
        names = [form.format(path) for form in _MASK_NAMES]
        folders = folder / path.parent.relative_to(root), path.parent / folder.name, folder
        if (mask := next((beside / n for beside in folders for n in names if (beside / n).is_file()), None)) is None:
            raise DataError(f"{path} has no mask {path.stem}.png in {folder}; add it, white where pixels count")
        if mask in masks:
            raise DataError(f"{path} and another photo have one mask, {mask}; put masks into folders as the photos are")
        size, orientation = images.check_image(mask, mask=True), images.exif_orientation(path)
        # A mask of the upright size is upright; where both sizes are the same, nothing says so.
        known = orientation == 1 or (orientation in images.TURNED and size == wanted != size[::-1])
        if not known or images.exif_orientation(mask) != 1:
            raise DataError(f"{path} or its mask is turned by its EXIF entry, and the other is not; save both upright")
        if size != wanted:
            raise DataError(f"{mask} has {size[0]} x {size[1]} px and its photo {wanted[0]} x {wanted[1]}; scale it")
        masks.append(mask)
    return masks
