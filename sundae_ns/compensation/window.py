"""The window of a training image on which the head trains.

Windows of large images are random, so the cost of a step does not grow with the image size. Half of the steps see the
mirror image, against overfitting to the training views.
"""

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
    mirrored: bool = False
    """Whether it is seen in a mirror: left and right change places."""


def training_window(width: int, height: int, max_pixels: int, seed: int, *, mirror: bool = False) -> Window | None:
    """A random window with the image's aspect ratio, or None to train on the whole image, not mirrored.

    Positions are drawn from beyond the edges too and moved back inside, because uniform ones would rarely include the
    pixels next to the edges.

    Args:
        width: image width in pixels.
        height: image height in pixels.
        max_pixels: largest number of pixels of a window; 0 for no limit.
        seed: the window is a function of it, so that a resumed run uses the same windows.
        mirror: whether one of two windows is mirrored.
    """
    whole = max_pixels == 0 or width * height <= max_pixels
    if whole and not mirror:
        return None
    u, v, side = torch.rand(3, generator=torch.Generator().manual_seed(seed)).tolist()
    mirrored = mirror and side < 0.5
    if whole:
        return Window(0, 0, width, height, mirrored) if mirrored else None
    share = (max_pixels / (width * height)) ** 0.5
    columns, rows = (min(max(int(length * share) // GRID * GRID, GRID), length) for length in (width, height))
    left, top = int(width * u - columns / 2), int(height * v - rows / 2)
    return Window(min(max(left, 0), width - columns), min(max(top, 0), height - rows), columns, rows, mirrored)
