"""Image metrics, each in one named variant; ``lpips.py`` has the learned one.

PSNR is over all pixels and channels, with a peak of 1. SSIM is pytorch_msssim's, as in splatfacto: an 11 x 11 Gaussian
window with sigma 1.5, no padding ("valid"), averaged over pixels and colour channels. Other libraries pad or normalise the
variance differently; their values differ in the fourth digit.
"""

from __future__ import annotations

import torch
from pytorch_msssim import ssim as _windowed_ssim
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.gpu.fused_loss import SSIM_WINDOW


def check_pair(pred: Tensor, target: Tensor) -> None:
    """Raise DataError unless both are images ``[H, W, 3]`` of one size."""
    if pred.shape != target.shape or pred.dim() != 3 or pred.shape[-1] != 3:
        raise DataError(
            f"Images have shapes {list(pred.shape)} and {list(target.shape)}; give two of one size, [H, W, 3]."
        )


def psnr(pred: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio ``-10 log10(MSE)``, in dB; infinite for equal images.

    Args:
        pred: ``[H, W, 3]``, nominally in [0, 1]; not clamped here.
        target: ``[H, W, 3]`` in [0, 1].

    Returns:
        A scalar of the inputs' dtype and device; differentiable.

    Raises:
        DataError: the shapes differ, or are not ``[H, W, 3]``.
    """
    check_pair(pred, target)
    return -10 * torch.log10(torch.mean((pred - target) ** 2))


def ssim(pred: Tensor, target: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004), pytorch_msssim's variant with the valid window and a data range of 1.

    Args:
        pred: ``[H, W, 3]``, nominally in [0, 1].
        target: ``[H, W, 3]`` in [0, 1].

    Returns:
        A scalar of the inputs' dtype and device; differentiable. NaN if a side is shorter than the window, 11 pixels:
        pytorch_msssim would not smooth along that side and return another quantity.

    Raises:
        DataError: the shapes differ, or are not ``[H, W, 3]``.
    """
    check_pair(pred, target)
    if min(pred.shape[:2]) < SSIM_WINDOW:
        return pred.new_full((), float("nan"))
    return _windowed_ssim(pred.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], data_range=1.0)
