"""Images whose EXIF entry says that their pixels are turned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sundae_ns.errors import DataError

TURNED = (5, 6, 7, 8)
"""EXIF orientations that swap width and height."""
_ORIENTATION = 0x0112


def exif_orientation(path: Path) -> int:
    """EXIF orientation of an image, from 1 (as stored) to 8; 1 if it states none."""
    try:
        with Image.open(path) as image:
            found = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # decoders raise many kinds; a damaged entry is none
        return 1
    return found if isinstance(found, int) and 1 <= found <= 8 else 1


def turn(pixels: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Stored pixels ``[H, W, C]`` as they are to be seen, by one of :data:`TURNED`: ``[W, H, C]``."""
    turned = {
        5: lambda: pixels.swapaxes(0, 1),
        6: lambda: np.rot90(pixels, -1),
        7: lambda: np.rot90(pixels.swapaxes(0, 1), 2),
        8: lambda: np.rot90(pixels, 1),
    }
    return np.ascontiguousarray(turned[orientation]())


def wrong_size(path: Path, size: tuple[int, ...], expected: tuple[int, int], orientation: int) -> DataError:
    """The error for an image whose size is not that of its camera."""
    text = f"{path.name} is {size[0]} x {size[1]} px but its camera says {expected[0]} x {expected[1]}; "
    if orientation in TURNED:
        return DataError(f"{text}it is also turned by its EXIF entry: turn its pixels and remove the entry")
    if max(abs(one - other) for one, other in zip(size, expected, strict=True)) <= 1:
        return DataError(
            f"{text}it was rounded another way: give colmap --downscale-rounding-mode round (or ceil), or make the "
            "smaller images again"
        )
    return DataError(f"{text}give each size its own camera, or resize the images")
