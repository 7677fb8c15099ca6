"""The compiled loss of a CPU against convolutions in float64."""

from __future__ import annotations

import pytest
import torch
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.training import losses
from sundae_ns.training.cpu_loss import compiled_loss
from sundae_ns.training.losses import convolved_loss, image_losses

SIZES = [(11, 11), (11, 40), (40, 12), (37, 53), (64, 96)]


def ssim() -> SSIM:
    return SSIM(data_range=1.0, channel=3)


def images(height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """An image, its base colours and the truth."""
    generator = torch.Generator().manual_seed(height * width)
    truth = torch.rand(height, width, 3, generator=generator)
    image, base = (truth + 0.05 * torch.randn(truth.shape, generator=generator) for _ in range(2))
    return image.requires_grad_(), base.requires_grad_(), truth


def exact(image: Tensor, base: Tensor, truth: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    truth = truth.double()
    return convolved_loss(image.double(), truth, ssim(), weight), (base.double() - truth).abs().mean()


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_values_and_gradients_are_those_of_convolutions(height: int, width: int, weight: float) -> None:
    image, base, truth = images(height, width)
    found, expected = compiled_loss(image, truth, weight, base), exact(image, base, truth, weight)
    for value, wanted in zip(found, expected):
        assert value is not None
        torch.testing.assert_close(value.double(), wanted, rtol=1e-6, atol=1e-6)  # worst: 4e-8
    grads, wanted_grads = (
        torch.autograd.grad(1.5 * pair[0] + 0.3 * pair[1], (image, base)) for pair in (found, expected)
    )
    for grad, wanted in zip(grads, wanted_grads):
        assert (grad - wanted).norm() < 5e-6 * wanted.norm()  # worst: 6e-7
        assert (grad != 0).all()


def test_a_weight_of_its_own_for_l1() -> None:
    image, _, truth = images(37, 53)
    found, wanted = compiled_loss(image, truth, 0.2, l1_weight=0.0)[0], convolved_loss(image, truth, ssim(), 0.2, 0.0)
    torch.testing.assert_close(found, wanted)
    (grad,), (expected,) = (torch.autograd.grad(loss, image) for loss in (found, wanted))
    torch.testing.assert_close(grad, expected, rtol=1e-4, atol=1e-8)


def test_it_rounds_as_convolutions_in_single_precision() -> None:
    image, base, truth = images(48, 48)
    (wanted,) = torch.autograd.grad(exact(image, base, truth, 1.0)[0], image)

    def error(value: Tensor) -> Tensor:
        return (torch.autograd.grad(value, image)[0] - wanted).norm() / wanted.norm()

    assert error(compiled_loss(image, truth, 1.0)[0]) < 1.5 * error(convolved_loss(image, truth, ssim(), 1.0)) + 1e-7


def test_the_same_bits_on_any_number_of_threads() -> None:
    image, base, truth = images(150, 70)

    def bits() -> list[Tensor]:
        loss, of_base = compiled_loss(image, truth, 0.2, base)
        assert of_base is not None
        return [loss, of_base, *torch.autograd.grad(loss + of_base, (image, base))]

    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 8):
            torch.set_num_threads(threads)
            found.append(bits())
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other))


def test_images_alike_have_no_loss_and_no_gradient() -> None:
    truth = images(32, 24)[2]
    image, base = truth.clone().requires_grad_(), truth.clone().requires_grad_()
    loss, of_base = compiled_loss(image, truth, 0.2, base)
    assert of_base is not None
    (loss + of_base).backward()
    assert loss.item() == pytest.approx(0, abs=1e-7)
    assert of_base.item() == 0
    assert image.grad is not None
    assert base.grad is not None
    assert image.grad.abs().max() < 1e-7
    assert not base.grad.any()


def test_a_pixel_that_is_no_number_shows() -> None:
    image, _, truth = images(32, 24)
    with torch.no_grad():
        image[16, 12, 1] = torch.nan
    loss = compiled_loss(image, truth, 0.2)[0]
    loss.backward()
    assert loss.isnan()
    assert image.grad is not None
    assert image.grad[16, 12, 1].isnan()
    assert image.grad[0, 0].isfinite().all()


def test_images_of_any_layout_and_without_base_colours() -> None:
    image, _, truth = images(40, 23)
    expected = compiled_loss(image, truth, 0.2)
    planes, whole = image.detach().permute(2, 0, 1).contiguous().requires_grad_(), truth.repeat(1, 2, 1)
    found = compiled_loss(planes.permute(1, 2, 0), whole[:, :23], 0.2)
    assert expected[1] is None
    assert found[1] is None
    assert torch.equal(found[0], expected[0])
    grads = torch.autograd.grad(found[0], planes)[0], torch.autograd.grad(expected[0], image)[0]
    assert torch.equal(grads[0].permute(1, 2, 0), grads[1])


def test_the_loss_of_a_step_is_compiled_where_numba_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    image, base, truth = images(32, 24)
    expected = compiled_loss(image, truth, 0.2, base)
    found = image_losses(image, base, truth, ssim(), 0.2)
    assert all(torch.equal(a, b) for a, b in zip(found, expected) if a is not None and b is not None)
    monkeypatch.setattr(losses, "numba_problem", lambda: "numba does not import")
    convolved = image_losses(image, base, truth, ssim(), 0.2)
    assert torch.equal(convolved[0], convolved_loss(image, truth, ssim(), 0.2))
    torch.testing.assert_close(convolved[0], expected[0])
    torch.testing.assert_close(convolved[1], expected[1])
