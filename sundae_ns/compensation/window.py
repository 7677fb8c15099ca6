"""Random windows of large training images, so that the cost of a step does not grow with the image size."""

from __future__ import annotations

from typing import NamedTuple

import torch

GRID = 16
"""Sides of a window are multiples of this many pixels, so that the U-Net needs no padding."""


class Window(NamedTuple):
    """A rectangle of an image, in pixels."""

    left: int
    top: int
    width: int
    height: int


def training_window(width: int, height: int, max_pixels: int, seed: int) -> Window | None:
    """A random window with the image's aspect ratio, or None to train on the whole image.

    Positions are drawn from beyond the edges too and moved back inside, because uniform ones would rarely include the
    pixels next to the edges.

    Args:
        width: image width in pixels.
        height: image height in pixels.
        max_pixels: largest number of pixels of a window; 0 for no limit.
        seed: the window is a function of it, so that a resumed run uses the same windows.
    """
    if max_pixels == 0 or width * height <= max_pixels:
        return None
    share = (max_pixels / (width * height)) ** 0.5
    w, h = (min(max(int(side * share) // GRID * GRID, GRID), side) for side in (width, height))
    u, v = torch.rand(2, generator=torch.Generator().manual_seed(seed)).tolist()
    left, top = int(width * u - w / 2), int(height * v - h / 2)
    return Window(min(max(left, 0), width - w), min(max(top, 0), height - h), w, h)
