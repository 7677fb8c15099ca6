"""Quality of images under masks."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sundae_ns.evaluation import psnr, ssim
from sundae_ns.evaluation.metrics import MOST_PSNR
from sundae_ns.training.heldout import HeldOutQuality, mean_quality, view_quality


@pytest.fixture
def pair() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    target = torch.rand(24, 32, 3, generator=generator)
    return (target + 0.1 * torch.rand(24, 32, 3, generator=generator)).clamp(0, 1), target


def test_without_a_mask_it_is_that_of_the_whole_image(pair: tuple[Tensor, Tensor]) -> None:
    found = view_quality(*pair, None)
    assert found.pixels == 24 * 32
    assert found.psnr == pytest.approx(float(psnr(*pair)))
    assert found.ssim == pytest.approx(float(ssim(*pair)))


def test_only_pixels_under_the_mask_count(pair: tuple[Tensor, Tensor]) -> None:
    image, target = pair
    mask = torch.zeros(24, 32, dtype=torch.bool)
    mask[:, :16] = True
    spoilt = torch.where(mask[..., None], image, torch.full_like(image, math.nan))
    found = view_quality(spoilt, target, mask)
    error = (image - target)[:, :16].square().mean()
    assert found.pixels == 24 * 16
    assert found.psnr == pytest.approx(float(-10 * torch.log10(error)), abs=1e-4)
    # Half of the image is exact, and must not hide the other half; windows across the border see both.
    whole = float(ssim(torch.where(mask[..., None], image, target), target))
    half = float(ssim(image[:, :16], target[:, :16]))
    assert abs(found.ssim - half) < 0.3 * abs(whole - half)


def test_views_count_by_their_pixels_and_a_masked_view_not_at_all(pair: tuple[Tensor, Tensor]) -> None:
    assert view_quality(*pair, torch.zeros(24, 32, dtype=torch.bool)).pixels == 0
    assert mean_quality([HeldOutQuality(300, 20.0, 0.5), HeldOutQuality(100, 40.0, 0.9)]) == (25.0, pytest.approx(0.6))


def test_an_exact_image_is_finite_and_a_broken_one_is_not(pair: tuple[Tensor, Tensor]) -> None:
    image, target = pair
    assert view_quality(target, target, None).psnr == MOST_PSNR
    assert not math.isfinite(view_quality(torch.full_like(image, math.nan), target, None).psnr)


def test_an_image_smaller_than_the_window_of_ssim_has_a_psnr(pair: tuple[Tensor, Tensor]) -> None:
    image, target = (one[:8] for one in pair)
    found = view_quality(image, target, None)
    assert found.ssim == 0
    assert math.isfinite(found.psnr)
