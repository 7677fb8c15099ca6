"""Images of another scale than those the head was trained on.

A screen-space network learns one size of a pixel in the scene. On an image of half or twice the focal length it may do
harm. Such images are compensated at the trained scale, and the correction is resized.
"""

from __future__ import annotations

from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor

TOLERANCE = 1.01
"""Ratio of focal lengths up to which the head runs at the image's own scale: the difference between training and test
cameras. An image 2% larger or smaller is better with the correction of the trained scale."""
FADE = (4.0, 2.0)
"""Images shrunk by more than the first factor are shown without the head, those by less than the second with all of it:
a thumbnail must not cost a full-size image, nor the head appear abruptly during a zoom."""

MAX_PIXELS = 2**24
"""The head also fades out for images with more pixels than this at the trained scale, such as a wide view. It is off
at twice as many: 33 million pixels take two gigabytes."""

MARGIN = 1.25
"""The pixel limit does not apply at scales up to this factor, whatever the size of the image."""


class ScalePlan(NamedTuple):
    """Scale and weight at which an image is compensated."""

    zoom: float
    """Factor on the focal length and sides of the image at which the head runs; 1 for the image itself."""
    weight: float
    """Share of the correction that is added; 0 means that the head need not run."""


def plan(focal: float, trained: tuple[float, float] | None, pixels: int) -> ScalePlan:
    """Plan the compensation of an image.

    Args:
        focal: focal length of the image, pixels.
        trained: shortest and longest focal length of the training images; None if unknown.
        pixels: number of pixels of the image.
    """
    if trained is None:
        return ScalePlan(1.0, 1.0)
    nearest = min(max(focal, trained[0]), trained[1])
    zoom = nearest / focal
    if 1 / TOLERANCE <= zoom <= TOLERANCE:
        return ScalePlan(1.0, 1.0)
    limit = max(MAX_PIXELS, MARGIN**2 * pixels)
    return ScalePlan(zoom, min(_fading(zoom, *FADE), _fading(pixels * zoom**2, 2 * limit, limit)))


def _fading(value: float, off: float, full: float) -> float:
    """1 up to ``full``, then linearly down to 0 at ``off``."""
    return min(max((off - value) / (off - full), 0.0), 1.0)


def resize(image: Tensor, height: int, width: int) -> Tensor:
    """Resize ``[h, w, C]`` to ``[height, width, C]``, antialiased where it shrinks."""
    planes = image.permute(2, 0, 1)[None]
    resized = F.interpolate(planes, size=(height, width), mode="bilinear", align_corners=False, antialias=True)
    return resized[0].permute(1, 2, 0)
