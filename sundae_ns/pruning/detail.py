"""Detail of an image that a given number of primitives cannot show."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

FLOOR = 0.25
"""Weight of a flat pixel, as a share of the image's root mean square: flat areas need some primitives too."""


@torch.no_grad()
def pixel_detail(image: Tensor, cells: float) -> Tensor:
    """Local deviation of an image from its mean over a cell, as weights of the pixels.

    A primitive covers a cell of about ``H W / cells`` pixels, and the deviation within a window of that size is the
    detail that it cannot show. The squared error of n cells is least if their density is proportional to the gradient
    (minimise ``int |grad f|^2 / density``), and in a smooth image the deviation is proportional to the gradient.

    Args:
        image: colours in [0, 1], any device ``[H, W, C]``.
        cells: number of cells, positive.

    Returns:
        Weights of the pixels, positive with mean 1 ``[H, W]``; all 1 for a flat image.
    """
    height, width = image.shape[:2]
    side = round((height * width / max(cells, 1.0)) ** 0.5)
    # An odd window of at least 3 pixels; its half is the padding, and must not exceed the image.
    half = max(1, min(side, height, width) // 2)
    planes = image.detach().permute(2, 0, 1).nan_to_num()[None].double()

    def local_mean(values: Tensor) -> Tensor:
        # Rows, then columns: a square window of many pixels would take long.
        for window, padding in (((2 * half + 1, 1), (half, 0)), ((1, 2 * half + 1), (0, half))):
            values = avg_pool2d(values, window, stride=1, padding=padding, count_include_pad=False)
        return values

    variance = (local_mean(planes.square()) - local_mean(planes).square()).clamp_min(0).sum(dim=1)[0]
    mean = variance.mean()
    if not mean > 0:
        return torch.ones_like(variance).to(image.dtype)
    weights = (variance + FLOOR**2 * mean).sqrt()
    return (weights / weights.mean()).to(image.dtype)
