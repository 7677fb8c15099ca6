"""Photos as the images of a capture: upright, in a folder for each camera, and smaller ones beside them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from PIL import Image

from sundae_ns.data.capture import check_image, undecodable
from sundae_ns.data.layouts import LONGEST_SIDE
from sundae_ns.data.photos import Photo, upright
from sundae_ns.errors import DataError, writing

_QUALITY = 95
"""Of JPEG files that are made of other formats."""


def names_of(photos: Sequence[Photo]) -> list[str]:
    """Paths of images in the working folder, ``c1/frame_00001.jpg``, in the order of the photos.

    Photos of a folder ``c1``, ``c2``, ... share size, camera, lens and focal length.
    """
    cameras: dict[object, int] = {}
    names = []
    for number, photo in enumerate(photos, start=1):
        camera = cameras.setdefault((photo.size, photo.lens), len(cameras) + 1)
        names.append(f"c{camera}/frame_{number:05d}{photo.suffix}")
    return names


def write_images(photos: Sequence[Photo], folder: Path, advance: Callable[[int], None]) -> None:
    """Write the photos under their :func:`names_of`; those that are there stay.

    Args:
        photos: the photos.
        folder: of the images.
        advance: called with the number of further images.

    Raises:
        DataError: the pixels of a photo cannot be decoded, or a raw photo has another size than the others.
        StorageError: the disk is full or not writable.
    """
    raw: set[tuple[int, int]] = set()
    for photo, name in zip(photos, names_of(photos), strict=True):
        path = folder / name
        if not path.exists():
            with writing(f"cannot write {path}"):
                path.parent.mkdir(parents=True, exist_ok=True)
                _write(photo, path)
        if photo.size == (0, 0):
            raw.add(check_image(path))
        if len(raw) > 1:
            raise DataError(f"raw photos of several sizes ({photo.path} differs); save them as JPEG")
        advance(1)


def _write(photo: Photo, path: Path) -> None:
    partial = path.with_name(f"{path.name}.partial")
    image = upright(photo)  # decodes: what is broken is named before the work of hours
    if photo.as_it_is:
        shutil.copyfile(photo.path, partial)
    else:
        kind = "PNG" if photo.suffix == ".png" else "JPEG"
        image = image if kind == "PNG" or image.mode == "L" else image.convert("RGB")
        image.save(partial, format=kind, quality=_QUALITY, subsampling=0, exif=image.getexif())
    partial.replace(path)


def write_smaller(images: Path, advance: Callable[[int], None]) -> None:
    """Write ``images_2``, ``images_4``, ... beside a folder: three sizes, or more for the largest images.

    nerfstudio trains at the first size of at most 1,600 pixels, or at one that the user names. A size that is odd is
    rounded down, as its cameras are.
    """
    paths = sorted(images.iterdir())
    longest, factors = max(max(check_image(path)) for path in paths), [2, 4, 8]
    while longest / factors[-1] > LONGEST_SIDE:
        factors.append(2 * factors[-1])
    for factor in factors:
        images.with_name(f"{images.name}_{factor}").mkdir(exist_ok=True)
    for path in paths:
        _write_sizes(path, images, factors)
        advance(1)


def _write_sizes(path: Path, images: Path, factors: Sequence[int]) -> None:
    try:
        with Image.open(path) as image:
            image.load()
            whole = image.copy()
    except Exception as error:  # decoders raise many kinds
        raise undecodable(path, error) from error
    for factor in factors:
        size = max(1, whole.width // factor), max(1, whole.height // factor)
        partial = images.with_name(f"{images.name}_{factor}") / path.name  # in a folder that is renamed
        whole.resize(size, Image.Resampling.BOX).save(partial, quality=_QUALITY, subsampling=0)
