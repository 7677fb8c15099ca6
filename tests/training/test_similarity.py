"""SSIM in one convolution against pytorch_msssim."""

from __future__ import annotations

import pytest
import torch
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.training.similarity import mean_ssim


@pytest.fixture
def ssim() -> SSIM:
    return SSIM(data_range=1.0, size_average=True, channel=3)


@pytest.mark.parametrize(("height", "width"), [(11, 11), (40, 23), (64, 96)])
def test_value_and_gradient_are_pytorch_msssims(ssim: SSIM, height: int, width: int) -> None:
    generator = torch.Generator().manual_seed(height)
    target = torch.rand(1, 3, height, width, generator=generator, dtype=torch.float64)
    noise = torch.rand(target.shape, generator=generator, dtype=torch.float64)

    def graded(value: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
        return value.detach(), torch.autograd.grad(value, image)[0]

    image = (0.8 * target + 0.2 * noise).requires_grad_()
    found, expected = graded(mean_ssim(image, target, ssim), image), graded(ssim(target, image), image)
    torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-14)
    assert found[1].abs().min() > 0


def test_single_precision_rounds_as_pytorch_msssims(ssim: SSIM) -> None:
    generator = torch.Generator().manual_seed(5)
    target = torch.rand(1, 3, 48, 48, generator=generator)
    image = (target + 0.02 * torch.randn(target.shape, generator=generator)).requires_grad_()

    def errors(value: Tensor) -> Tensor:
        """Distance of the gradient from that in double precision, relative to its norm."""
        (exact,) = torch.autograd.grad(ssim(target.double(), image.double()), image)
        (found,) = torch.autograd.grad(value, image)
        return (found - exact).norm() / exact.norm()

    assert errors(mean_ssim(image, target, ssim)) < 1.5 * errors(ssim(target, image)) + 1e-7


def test_images_alike_have_ssim_one(ssim: SSIM) -> None:
    target = torch.rand(1, 3, 16, 16)
    assert mean_ssim(target, target, ssim) == pytest.approx(1, abs=1e-6)
