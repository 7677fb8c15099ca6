"""Fused loss and gradient, one kernel each: the CUDA source, compiled for the CPU, against pytorch_msssim.

A block has one thread on the CPU: only the tests on a GPU cover shared memory and the sum over threads.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.errors import BackendError, DataError, SundaeError
from sundae_ns.gpu import fused_loss as fused
from sundae_ns.gpu.fused_loss import fused_loss
from sundae_ns.gpu.nvrtc import Launch, kernels_where_possible
from sundae_ns.training.losses import image_losses

SIZES = [(11, 11), (11, 300), (12, 43), (26, 42), (27, 43), (64, 97)]


@pytest.fixture(autouse=True)
def on_cpu(request: pytest.FixtureRequest, load_on_cpu: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    if not request.node.get_closest_marker("gpu"):
        monkeypatch.setattr(fused, "load_kernels", load_on_cpu)


def images(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """An image near its target, and the target, with edges and flat parts."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator).mul(3).round() / 3
    target[: height // 3] = 0.25
    noise = torch.randn(height, width, 3, generator=generator)
    return (target + 0.1 * noise).clamp(0, 1), target


def exact(image: Tensor, target: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """Loss and gradient by convolutions in float64."""
    image, ssim = image.double().requires_grad_(), SSIM(data_range=1.0, channel=3)
    ssim.win = ssim.win.to(image)  # moving the module leaves its window where it was
    loss = image_losses(image, None, target.double(), ssim, weight)[0]
    (gradient,) = torch.autograd.grad(loss, image)
    return loss.detach(), gradient


def found(image: Tensor, target: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    image = image.clone().requires_grad_()
    loss, _ = fused_loss(image, target, weight)
    (gradient,) = torch.autograd.grad(loss, image)
    return loss.detach(), gradient


def test_a_weight_of_its_own_for_l1() -> None:
    image, target = images(26, 42)
    mixed = fused_loss(image, target, 0.2)[0]
    alone = fused_loss(image, target, 0.2, l1_weight=0.0)[0]
    torch.testing.assert_close(mixed - alone, 0.8 * (image - target).abs().mean())


@pytest.mark.parametrize("weight", [0.2, 1.0])
@pytest.mark.parametrize("size", SIZES)
def test_the_loss_and_its_gradient(size: tuple[int, int], weight: float) -> None:
    pair = images(*size)
    loss, gradient = found(*pair, weight)
    expected, expected_gradient = exact(*pair, weight)
    assert loss.item() == pytest.approx(expected.item(), abs=2e-6)
    assert (gradient - expected_gradient).abs().max() < 2e-4 * expected_gradient.abs().max()


@pytest.mark.parametrize("size", SIZES)
def test_base_colours(size: tuple[int, int]) -> None:
    image, target = images(*size)
    base = images(*size, seed=1)[0].permute(1, 0, 2).contiguous().permute(1, 0, 2)
    expected, expected_gradient = found(image, target, 0.2)
    leaves = image.clone().requires_grad_(), base.clone().requires_grad_()
    loss, base_loss = fused_loss(leaves[0], target, 0.2, leaves[1])
    assert base_loss is not None
    assert not loss._is_view()
    assert torch.equal(loss, expected)
    assert base_loss.item() == pytest.approx((base - target).abs().mean().item(), rel=1e-5)
    grad_image, grad_base = torch.autograd.grad(2 * loss + 0.3 * base_loss, leaves)
    torch.testing.assert_close(grad_image, 2 * expected_gradient)
    torch.testing.assert_close(grad_base, 0.3 * (base - target).sign() / base.numel())


def test_base_colours_of_another_size_or_with_nan() -> None:
    image, target = images(30, 47)
    with pytest.raises(DataError, match="of one size"):
        fused_loss(image, target, 0.2, image[1:])
    base = target.clone()
    base[20, 30, 2] = torch.nan
    loss, base_loss = fused_loss(image, target, 0.2, base.requires_grad_())
    assert base_loss is not None
    assert loss.isfinite()
    assert base_loss.isnan()
    (gradient,) = torch.autograd.grad(base_loss, base)
    assert gradient.isnan().sum() == 1


def test_strides_and_later_operations_do_not_matter() -> None:
    image, target = images(40, 50)
    transposed = image.permute(1, 0, 2).contiguous().permute(1, 0, 2)
    expected, expected_gradient = found(image, target, 0.2)
    assert not transposed.is_contiguous()
    transposed.requires_grad_()
    (gradient,) = torch.autograd.grad(3 * fused_loss(transposed, target.flip(0).flip(0), 0.2)[0], transposed)
    torch.testing.assert_close(gradient, 3 * expected_gradient)
    with torch.no_grad():
        assert torch.equal(fused_loss(image, target, 0.2)[0], expected)


def test_equal_images_have_no_loss() -> None:
    for image in (images(40, 50)[1], torch.zeros(20, 20, 3), torch.ones(20, 20, 3)):
        loss, gradient = found(image, image.clone(), 0.5)
        assert abs(loss) < 1e-6
        assert gradient.abs().max() < 1e-5


def test_a_small_loss_is_accurate() -> None:
    """It is not computed as the difference of two large sums."""
    image, target = images(64, 97)
    near = target + 1e-3 * (image - target)
    loss, _ = found(near, target, 1.0)
    expected, _ = exact(near, target, 1.0)
    assert 0 < expected < 1e-4
    assert loss.item() == pytest.approx(expected.item(), rel=0.02)


@pytest.mark.parametrize("scale", [1e-4, 1e2, 1e4])
def test_values_of_any_size(scale: float) -> None:
    pair = [scale * p for p in images(30, 47)]
    loss, gradient = found(*pair, 0.2)
    expected, expected_gradient = exact(*pair, 0.2)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-4, abs=1e-6)
    assert (gradient - expected_gradient).abs().max() < 2e-3 * expected_gradient.abs().max()


def test_nan_propagates() -> None:
    image, target = images(30, 47)
    image[15, 20, 1] = torch.nan
    loss, gradient = found(image, target, 0.2)
    assert loss.isnan()
    assert gradient[15, 20, 1].isnan()
    assert gradient[:4].isfinite().all()


def test_it_compiles_for_a_gpu(compile_for_gpu: Callable[..., bytes]) -> None:
    assert compile_for_gpu("loss.cu", "sm_90", fused.OPTIONS)


@pytest.mark.parametrize(
    "target", [torch.zeros(20, 30, 3), torch.zeros(40, 30, 4), torch.zeros(40, 30, 3).double(), torch.zeros(40, 30)]
)
def test_unsupported_images_are_refused(target: Tensor) -> None:
    for pair in ((torch.zeros(40, 30, 3), target), (target, target)):
        if pair[0].shape != (20, 30, 3):
            with pytest.raises(DataError, match=r"pass float32 \[H, W, 3\] of one size"):
                fused_loss(*pair, 0.2)
    with pytest.raises(DataError, match="at least 11 px per side"):
        fused_loss(torch.zeros(10, 30, 3), torch.zeros(10, 30, 3), 0.2)


def test_no_second_gradient_and_none_for_the_target() -> None:
    image, target = (p.requires_grad_() for p in images(20, 30))
    with pytest.raises(SundaeError, match="no second derivative"):
        torch.autograd.grad(fused_loss(image, target, 0.2)[0], image, create_graph=True)
    assert not fused_loss(image.detach(), target, 0.2)[0].requires_grad


def test_missing_kernels_are_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    def refuse(_: torch.device) -> dict[str, Launch]:
        raise BackendError("NVRTC fails: update torch")

    assert [kernels_where_possible(refuse, torch.device("cpu"), "it is slow") for _ in range(2)] == [None, None]
    assert caplog.text.count("it is slow, on cpu: NVRTC fails") == 1


@pytest.mark.gpu
@pytest.mark.parametrize("size", [*SIZES, (1061, 1893)])
def test_on_a_gpu(size: tuple[int, int]) -> None:
    image, target = (p.cuda().requires_grad_(n == 0) for n, p in enumerate(images(*size)))
    loss = image_losses(image, None, target, SSIM(data_range=1.0, channel=3).cuda(), 0.2)[0]
    assert "_Loss" in type(loss.grad_fn).__name__
    (gradient,) = torch.autograd.grad(loss, image)
    expected, expected_gradient = exact(image.detach(), target, 0.2)
    assert loss.item() == pytest.approx(expected.item(), abs=2e-6)
    assert (gradient - expected_gradient).abs().max() < 2e-4 * expected_gradient.abs().max()
    base = images(*size, seed=1)[0].cuda().requires_grad_()
    both = image_losses(image, base, target, SSIM(data_range=1.0, channel=3), 0.2)
    assert both[1] is not None
    assert torch.equal(both[0], loss)
    assert both[1].item() == pytest.approx((base - target).abs().mean().item(), rel=1e-5)
    gradients = torch.autograd.grad(both[0] + both[1], (image, base))
    assert torch.equal(gradients[0], gradient)
    torch.testing.assert_close(gradients[1], (base - target).sign() / base.numel())
    others = ((image[:10], target[:10], 0.2), (image, target, 0.0), (image.double(), target.double(), 0.2))
    for *pair, weight in others:  # too small, without SSIM, in another precision
        elsewhere = image_losses(pair[0], None, pair[1], SSIM(data_range=1.0, channel=3), weight)[0]
        assert "_Loss" not in type(elsewhere.grad_fn).__name__
    again = torch.autograd.grad(image_losses(image, None, target, SSIM(data_range=1.0, channel=3), 0.2)[0], image)[0]
    assert torch.equal(again, gradient)
