"""Windows of large pictures to train on, so that a step costs the same however many pixels a capture has."""

from __future__ import annotations

from typing import NamedTuple

import torch

GRID = 16
"""Sides of a window are multiples of this many pixels, so that the U-Net need not pad it."""


class Window(NamedTuple):
    """A part of a picture, in pixels."""

    left: int
    top: int
    width: int
    height: int


def training_window(width: int, height: int, max_pixels: int, seed: int) -> Window | None:
    """A random window of the picture's own aspect ratio.

    Positions are drawn from beyond the picture's edges too and moved back inside, because uniform ones would hardly ever
    show the pixels next to the edges.

    Args:
        width: of the picture, pixels.
        height: of the picture, pixels.
        max_pixels: most pixels of a window; 0 for no limit.
        seed: the window is a function of it, so that a resumed run sees the windows of one that was never stopped.

    Returns:
        None where the whole picture is to be trained on.
    """
    if max_pixels == 0 or width * height <= max_pixels:
        return None
    share = (max_pixels / (width * height)) ** 0.5
    w, h = (min(max(int(side * share) // GRID * GRID, GRID), side) for side in (width, height))
    u, v = torch.rand(2, generator=torch.Generator().manual_seed(seed)).tolist()
    left, top = int(width * u - w / 2), int(height * v - h / 2)
    return Window(min(max(left, 0), width - w), min(max(top, 0), height - h), w, h)
