"""SSIM of one pair of images with all of its window sums in one convolution, on any device."""

from __future__ import annotations

import torch
from pytorch_msssim import SSIM
from torch import Tensor
from torch.nn.functional import conv2d


def mean_ssim(image: Tensor, target: Tensor, ssim: SSIM) -> Tensor:
    """Mean SSIM as ``ssim(image, target)`` computes it, up to rounding.

    pytorch_msssim blurs five maps by ten convolutions of three channels each. A CPU pads these to sixteen channels, as
    many as the fifteen of all maps need.

    Args:
        image: planes ``[1, C, H, W]``, differentiable; both sides at least as long as the window.
        target: the truth ``[1, C, H, W]``.
        ssim: window ``[C, 1, 1, K]``, constants and data range.

    Returns:
        A scalar.
    """
    maps = torch.cat([image, target, image * image, target * target, image * target], dim=1)
    groups = maps.shape[1]
    window = ssim.win[:1].to(maps).expand(groups, -1, -1, -1)
    maps = conv2d(conv2d(maps, window.transpose(2, 3), groups=groups), window, groups=groups)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = maps.chunk(5, dim=1)
    c1, c2 = ((constant * ssim.data_range) ** 2 for constant in ssim.K)
    square_x, square_y, product = mean_x * mean_x, mean_y * mean_y, mean_x * mean_y
    luminance = (2 * product + c1) / (square_x + square_y + c1)
    structure = (2 * (mean_xy - product) + c2) / (mean_xx - square_x + mean_yy - square_y + c2)
    return (luminance * structure).mean()
