"""Where a picture has detail that a given number of primitives would lose."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from sundae_ns.errors import DataError

FLOOR = 0.25
"""A flat pixel counts this share of the picture's root mean square: a wall needs primitives too, if few."""


@torch.no_grad()
def pixel_detail(picture: Tensor, cells: float) -> Tensor:
    """Local deviation of a picture from its mean over a cell, for a budget of so many cells.

    A primitive stands for a cell of the picture, about ``H W / cells`` pixels. What it cannot show is what lies above the
    band of that cell, and the deviation within a window of the cell's size is the size of it. To spread n cells so that the
    squared error is least, their density has to be in proportion to the gradient (by a variation of
    ``int |grad f|^2 / density``), to which the deviation is proportional where the picture is smooth.

    Args:
        picture: colours in [0, 1], any device ``[H, W, C]``.
        cells: budget, positive.

    Returns:
        Weights of the pixels, positive and with mean 1 ``[H, W]``; all 1 where the picture is flat.

    Raises:
        DataError: the picture has no such shape.
    """
    if picture.ndim != 3 or 0 in picture.shape:
        raise DataError(f"the picture has shape {list(picture.shape)}: pass [H, W, C]")
    height, width = picture.shape[:2]
    side = round((height * width / max(cells, 1.0)) ** 0.5)
    # An odd window of at least 3 pixels, which padding of half of it still finds a picture for.
    half = max(1, min(side, height, width) // 2)
    planes = picture.detach().permute(2, 0, 1).nan_to_num()[None].double()

    def local_mean(values: Tensor) -> Tensor:
        return avg_pool2d(values, 2 * half + 1, stride=1, padding=half, count_include_pad=False)

    variance = (local_mean(planes.square()) - local_mean(planes).square()).clamp_min(0).sum(dim=1)[0]
    mean = variance.mean()
    if not mean > 0:
        return torch.ones_like(variance).to(picture.dtype)
    weights = (variance + FLOOR**2 * mean).sqrt()
    return (weights / weights.mean()).to(picture.dtype)
