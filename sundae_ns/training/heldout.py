"""Quality of the images of held-out training views, for decisions that must not use test views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.evaluation import psnr, ssim
from sundae_ns.evaluation.metrics import MOST_PSNR, SSIM_WINDOW, fitted_psnr
from sundae_ns.rendering.render import render_view
from sundae_ns.training.extension import TrainingRun


class HeldOutQuality(NamedTuple):
    """Quality of the image of one held-out view. Both figures are NaN or infinite if the image is not finite."""

    pixels: int
    """Number of pixels that count: those under the mask."""
    psnr: float
    """PSNR of these pixels, dB, at most :data:`MOST_PSNR`."""
    ssim: float
    """SSIM of these pixels; 0 for an image that is smaller than the window of SSIM."""
    fitted: float = math.nan
    """PSNR of these pixels after the affine map of colours that fits best, dB: what is left if light and exposure of
    the photo differ from the others'. NaN if it was not asked for."""


def from_values(trial: Sequence[Sequence[float]]) -> list[HeldOutQuality]:
    """Qualities of views from the lists of values that checkpoints hold."""
    return [HeldOutQuality(int(pixels), *figures) for pixels, *figures in trial]


@torch.no_grad()
def measure_heldout(run: TrainingRun, *, with_fitted: bool = False) -> list[HeldOutQuality]:
    """Quality of the held-out views as the field is now, with the head if it is enabled; without fully masked views.

    Args:
        run: the training.
        with_fitted: whether to fit colours, too.
    """
    qualities = []
    for view, target, mask in run.heldout_views():
        images, _ = render_view(run.source, view, run.background, run.settings, depth=False)
        quality = view_quality(images["rgb"], target, mask)
        if quality.pixels:
            fitted = float(fitted_psnr(images["rgb"], target, mask)) if with_fitted else math.nan
            qualities.append(quality._replace(fitted=fitted))
    return qualities


def view_quality(image: Tensor, target: Tensor, mask: Tensor | None) -> HeldOutQuality:
    """Quality of an image under a mask.

    Args:
        image: ``[H, W, 3]``.
        target: the truth ``[H, W, 3]``.
        mask: pixels that count, bool ``[H, W]``; None for all.
    """
    whole = target[..., 0].numel()
    pixels = whole if mask is None else int(mask.sum())
    if not pixels:
        return HeldOutQuality(0, 0.0, 0.0)
    # Outside of the mask the compared image is exact, so all of its error belongs to the pixels that count.
    compared = image if mask is None else torch.where(mask[..., None], image, target)
    share = pixels / whole
    decibels = float(psnr(compared, target)) + 10 * math.log10(share)
    similarity = 0.0
    if min(target.shape[:2]) >= SSIM_WINDOW:
        similarity = 1 - (1 - float(ssim(compared, target))) / share
    return HeldOutQuality(pixels, min(decibels, MOST_PSNR), similarity)


def mean_quality(views: Sequence[HeldOutQuality]) -> tuple[float, float]:
    """PSNR (dB) and SSIM, each the mean over views weighted by the pixels that count; NaN without any."""
    total = sum(view.pixels for view in views)
    if not total:
        return math.nan, math.nan
    decibels = sum(view.pixels * view.psnr for view in views) / total
    similarity = sum(view.pixels * view.ssim for view in views) / total
    return decibels, similarity
