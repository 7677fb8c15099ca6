"""Every metric of one image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from sundae_ns.evaluation.jod import jod
from sundae_ns.evaluation.measured import ViewQuality
from sundae_ns.evaluation.metrics import fitted_psnr, flip, psnr, ssim


def quality_of(
    image: Tensor, truth: Tensor, lpips: Callable[[Tensor, Tensor], Any] | None = None, *, visible: bool = True
) -> ViewQuality:
    """Every metric of one image ``[H, W, 3]`` against its truth.

    Args:
        image: rendered.
        truth: the true image.
        lpips: LPIPS of two images, None where it cannot be computed; None leaves it out.
        visible: whether to compute what eyes see of the difference, FLIP and JOD.
    """
    found: dict[str, Any] = {"psnr": psnr(image, truth), "psnr_fitted": fitted_psnr(image, truth)}
    found |= {"ssim": ssim(image, truth), "lpips": None if lpips is None else lpips(image, truth)}
    if visible:
        found |= {"flip": flip(image, truth), "jod": jod(image, truth)}
    return ViewQuality(**{name: float(value) for name, value in found.items() if value is not None})
