"""OpenCV's SSIM on a CPU against convolutions in float64."""

from __future__ import annotations

import pytest
import torch
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.train.step import convolved_loss, image_losses, ssim_loss

SIZES = [(11, 11), (11, 40), (40, 12), (37, 53), (64, 96)]


def ssim() -> SSIM:
    return SSIM(data_range=1.0, channel=3)


def images(height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """An image, its base colours and the target."""
    generator = torch.Generator().manual_seed(height * width)
    target = torch.rand(height, width, 3, generator=generator)
    image, base = (target + 0.05 * torch.randn(target.shape, generator=generator) for _ in range(2))
    return image.requires_grad_(), base.requires_grad_(), target


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_losses_of_a_step_and_gradients_are_those_of_convolutions(height: int, width: int, weight: float) -> None:
    image, base, target = images(height, width)
    ours = image_losses(image, base, target, ssim(), weight)
    exact = image_losses(image.double(), base.double(), target.double(), ssim(), weight)
    for value, wanted in zip(ours, exact):
        assert value is not None
        assert wanted is not None
        torch.testing.assert_close(value.double(), wanted, rtol=1e-6, atol=1e-6)  # worst: 1.1e-7
    grads, wanted_grads = (torch.autograd.grad(1.5 * pair[0] + 0.3 * pair[1], (image, base)) for pair in (ours, exact))
    for grad, wanted in zip(grads, wanted_grads):
        assert (grad - wanted).norm() < 5e-6 * wanted.norm()  # worst: 6e-7
        assert (grad != 0).all()


def test_it_rounds_as_convolutions_in_single_precision() -> None:
    image, _, target = images(48, 48)
    (wanted,) = torch.autograd.grad(convolved_loss(image.double(), target.double(), ssim(), 1.0), image)

    def error(value: Tensor) -> Tensor:
        return (torch.autograd.grad(value, image)[0] - wanted).norm() / wanted.norm()

    assert error(ssim_loss(image, target)) < 1.5 * error(convolved_loss(image, target, ssim(), 1.0)) + 1e-7


def test_equal_images_have_no_loss_and_no_gradient() -> None:
    target = images(32, 24)[2]
    image = target.clone().requires_grad_()
    loss = ssim_loss(image, target)
    (gradient,) = torch.autograd.grad(loss, image)
    assert loss.item() == pytest.approx(0, abs=1e-7)
    assert gradient.abs().max() < 1e-7


def test_nan_propagates() -> None:
    image, _, target = images(32, 24)
    with torch.no_grad():
        image[16, 12, 1] = torch.nan
    loss = ssim_loss(image, target)
    (gradient,) = torch.autograd.grad(loss, image)
    assert loss.isnan()
    assert gradient[16, 12, 1].isnan()
    assert gradient[0, 0].isfinite().all()


def test_images_of_any_layout() -> None:
    image, _, target = images(40, 23)
    planes = image.detach().permute(2, 0, 1).contiguous().requires_grad_()
    losses = ssim_loss(planes.permute(1, 2, 0), target.repeat(1, 2, 1)[:, :23]), ssim_loss(image, target)
    assert torch.equal(*losses)
    grads = torch.autograd.grad(losses[0], planes)[0], torch.autograd.grad(losses[1], image)[0]
    assert torch.equal(grads[0].permute(1, 2, 0), grads[1])
