"""Pictures of another scale than the head was trained at.

A screen-space network knows one size of a pixel in the scene. Shown a picture of half or twice the focal length it may do
harm, so such pictures are compensated at the trained scale, and the correction is resized.
"""

from __future__ import annotations

from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor

TOLERANCE = 1.01
"""Ratio of focal lengths within which the head is used as it is: what test cameras differ by from those trained on. A picture
2% larger or smaller is better off with the correction of the trained scale (``docs/results.md``)."""
FADE = (4.0, 2.0)
"""Pictures shrunk by more than the first factor are shown without the head, those by less than the second with all of it:
a thumbnail should not cost a whole picture, nor the head appear at once while one zooms."""

MOST_PIXELS = 2**24
"""A picture that would have more pixels than this at the trained scale, as a wide view may, fades the head out as well, up to
twice as many; but for those that are larger themselves. 33 million pixels take two gigabytes."""

ROOM = 1.25
"""Pictures of any size are compensated at a scale that is larger by so much."""


class ScalePlan(NamedTuple):
    """How to compensate a picture."""

    zoom: float
    """Factor on the picture's focal length and sides at which the head runs; 1 for the picture itself."""
    weight: float
    """Share of the correction that is added; 0 means that the head need not run."""


def plan(focal: float, trained: tuple[float, float] | None, pixels: int) -> ScalePlan:
    """How to compensate a picture.

    Args:
        focal: focal length of the picture, pixels.
        trained: shortest and longest focal length of the training pictures; None where they are not known.
        pixels: how many the picture has.
    """
    if trained is None:
        return ScalePlan(1.0, 1.0)
    nearest = min(max(focal, trained[0]), trained[1])
    zoom = nearest / focal
    if 1 / TOLERANCE <= zoom <= TOLERANCE:
        return ScalePlan(1.0, 1.0)
    most = max(MOST_PIXELS, ROOM**2 * pixels)
    return ScalePlan(zoom, min(_fading(zoom, *FADE), _fading(pixels * zoom**2, 2 * most, most)))


def _fading(value: float, off: float, full: float) -> float:
    """1 up to ``full``, and from there straight down to 0 at ``off``."""
    return min(max((off - value) / (off - full), 0.0), 1.0)


def resize(image: Tensor, height: int, width: int) -> Tensor:
    """Resize ``[h, w, C]`` to ``[height, width, C]``, antialiased where it shrinks."""
    planes = image.permute(2, 0, 1)[None]
    resized = F.interpolate(planes, size=(height, width), mode="bilinear", align_corners=False, antialias=True)
    return resized[0].permute(1, 2, 0)
