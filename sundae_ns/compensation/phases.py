"""Averaging the head over shifted images, so that its output depends less on the position of the pixel grid.

A U-Net that folds and pools pixels is not equivariant to a shift by one pixel, which shows as flicker when the camera
moves. The mean over shifted images, each shifted back, depends less on their position. A residual head also trains on
mirrored images, so half of four runs see the image in a mirror: the head's errors differ there.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from sundae_ns.compensation.head import PHASES, CompensationHead


def over_phases(head: CompensationHead, base: Tensor, splatted: Tensor, alpha: Tensor) -> Tensor:
    """The head's image, or the mean of several; arguments and result are those of :meth:`CompensationHead.forward`.

    ``head.config.phases`` is the number of images. For inference only: training uses one at a time.
    """
    shifts = PHASES[head.config.phases]
    if len(shifts) == 1:
        return head(base, splatted, alpha)
    height, width, _ = base.shape
    step = max(head.config.pixel_unshuffle // 2, 1)
    total = torch.zeros_like(base)
    for rows, columns, mirrored in shifts:
        top, left = step * rows, step * columns
        mirrored = mirrored and head.config.mode == "residual"
        seen = [image.flip(1) if mirrored else image for image in (base, splatted, alpha)]
        # Pad by zeros, as the convolutions do; all to one size, since each size is recorded as a graph of its own.
        padding = (0, 0, left, step - left, top, step - top)
        shifted = head(*(F.pad(image, padding) for image in seen))[top : top + height, left : left + width]
        total += shifted.flip(1) if mirrored else shifted
    return total / len(shifts)
