"""Loss and gradient in one kernel each: the kernels' very lines, compiled for the CPU, against pytorch_msssim.

A block has one thread on the CPU: what its threads share, and the sum over them, only the tests on a GPU see.
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
from sundae_ns.gpu import nvrtc
from sundae_ns.gpu.fused_loss import Launches, fused_loss
from sundae_ns.training import losses
from sundae_ns.training.losses import picture_loss, picture_losses

SIZES = [(11, 11), (11, 300), (12, 43), (26, 42), (27, 43), (64, 97)]


@pytest.fixture(scope="module")
def launches(compile_kernels: Callable[..., dict[str, Any]]) -> Launches:
    return Launches(**compile_kernels(fused.SOURCE, Launches._fields, fused.definitions()))


def pictures(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """One with edges and flat parts, and one that is near it."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator).mul(3).round() / 3
    target[: height // 3] = 0.25
    noise = torch.randn(height, width, 3, generator=generator)
    return (target + 0.1 * noise).clamp(0, 1), target


def exact(picture: Tensor, target: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """Loss and gradient by convolutions in float64."""
    picture, ssim = picture.double().requires_grad_(), SSIM(data_range=1.0, channel=3)
    ssim.win = ssim.win.to(picture)  # moving the module leaves its window where it was
    loss = picture_loss(picture, target.double(), ssim, weight)
    (gradient,) = torch.autograd.grad(loss, picture)
    return loss.detach(), gradient


def found(picture: Tensor, target: Tensor, weight: float, launches: Launches) -> tuple[Tensor, Tensor]:
    picture = picture.clone().requires_grad_()
    loss, _ = fused_loss(picture, target, weight, launches=launches)
    (gradient,) = torch.autograd.grad(loss, picture)
    return loss.detach(), gradient


@pytest.mark.parametrize("weight", [0.2, 1.0])
@pytest.mark.parametrize("size", SIZES)
def test_the_loss_and_its_gradient(launches: Launches, size: tuple[int, int], weight: float) -> None:
    pair = pictures(*size)
    loss, gradient = found(*pair, weight, launches)
    expected, slope = exact(*pair, weight)
    assert loss.item() == pytest.approx(expected.item(), abs=2e-6)
    assert (gradient - slope).abs().max() < 2e-4 * slope.abs().max()


@pytest.mark.parametrize("size", SIZES)
def test_base_colours_beside_it(launches: Launches, size: tuple[int, int]) -> None:
    picture, target = pictures(*size)
    base = pictures(*size, seed=1)[0].permute(1, 0, 2).contiguous().permute(1, 0, 2)
    expected, slope = found(picture, target, 0.2, launches)
    leaves = picture.clone().requires_grad_(), base.clone().requires_grad_()
    loss, of_base = fused_loss(leaves[0], target, 0.2, leaves[1], launches)
    assert of_base is not None
    assert not loss._is_view()
    assert torch.equal(loss, expected)
    assert of_base.item() == pytest.approx((base - target).abs().mean().item(), rel=1e-5)
    to_picture, to_base = torch.autograd.grad(2 * loss + 0.3 * of_base, leaves)
    torch.testing.assert_close(to_picture, 2 * slope)
    torch.testing.assert_close(to_base, 0.3 * (base - target).sign() / base.numel())


def test_base_colours_of_another_size_or_with_a_hole(launches: Launches) -> None:
    picture, target = pictures(30, 47)
    with pytest.raises(DataError, match="of one size"):
        fused_loss(picture, target, 0.2, picture[1:], launches)
    base = target.clone()
    base[20, 30, 2] = torch.nan
    loss, of_base = fused_loss(picture, target, 0.2, base.requires_grad_(), launches)
    assert of_base is not None
    assert loss.isfinite()
    assert of_base.isnan()
    (gradient,) = torch.autograd.grad(of_base, base)
    assert gradient.isnan().sum() == 1


def test_strides_and_what_comes_after_it_do_not_matter(launches: Launches) -> None:
    picture, target = pictures(40, 50)
    turned = picture.permute(1, 0, 2).contiguous().permute(1, 0, 2)
    expected, slope = found(picture, target, 0.2, launches)
    assert not turned.is_contiguous()
    turned.requires_grad_()
    (gradient,) = torch.autograd.grad(3 * fused_loss(turned, target.flip(0).flip(0), 0.2, launches=launches)[0], turned)
    torch.testing.assert_close(gradient, 3 * slope)
    with torch.no_grad():
        assert torch.equal(fused_loss(picture, target, 0.2, launches=launches)[0], expected)


def test_the_same_picture_twice_loses_nothing(launches: Launches) -> None:
    for picture in (pictures(40, 50)[1], torch.zeros(20, 20, 3), torch.ones(20, 20, 3)):
        loss, gradient = found(picture, picture.clone(), 0.5, launches)
        assert abs(loss) < 1e-6
        assert gradient.abs().max() < 1e-5


def test_what_is_left_of_a_small_loss(launches: Launches) -> None:
    """Not the difference of two large sums."""
    picture, target = pictures(64, 97)
    near = target + 1e-3 * (picture - target)
    loss, _ = found(near, target, 1.0, launches)
    expected, _ = exact(near, target, 1.0)
    assert 0 < expected < 1e-4
    assert loss.item() == pytest.approx(expected.item(), rel=0.02)


@pytest.mark.parametrize("scale", [1e-4, 1e2, 1e4])
def test_values_of_any_size(launches: Launches, scale: float) -> None:
    pair = [scale * p for p in pictures(30, 47)]
    loss, gradient = found(*pair, 0.2, launches)
    expected, slope = exact(*pair, 0.2)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-4, abs=1e-6)
    assert (gradient - slope).abs().max() < 2e-3 * slope.abs().max()


def test_nan_is_not_hidden(launches: Launches) -> None:
    picture, target = pictures(30, 47)
    picture[15, 20, 1] = torch.nan
    loss, gradient = found(picture, target, 0.2, launches)
    assert loss.isnan()
    assert gradient[15, 20, 1].isnan()
    assert gradient[:4].isfinite().all()


def test_it_compiles_for_a_gpu() -> None:
    try:
        nvrtc._library("nvrtc")
    except BackendError as error:
        pytest.skip(str(error))
    assert nvrtc.compile_cubin(fused.SOURCE, "sm_90", fused.definitions())


@pytest.mark.parametrize(
    "target", [torch.zeros(20, 30, 3), torch.zeros(40, 30, 4), torch.zeros(40, 30, 3).double(), torch.zeros(40, 30)]
)
def test_pictures_that_do_not_fit_are_refused(launches: Launches, target: Tensor) -> None:
    for pair in ((torch.zeros(40, 30, 3), target), (target, target)):
        if pair[0].shape != (20, 30, 3):
            with pytest.raises(DataError, match=r"give float32 \[H, W, 3\] of one size"):
                fused_loss(*pair, 0.2, launches=launches)
    with pytest.raises(DataError, match="11 px or more a side"):
        fused_loss(torch.zeros(10, 30, 3), torch.zeros(10, 30, 3), 0.2, launches=launches)


def test_no_second_gradient_and_none_for_the_target(launches: Launches) -> None:
    picture, target = (p.requires_grad_() for p in pictures(20, 30))
    with pytest.raises(SundaeError, match="no second derivative"):
        torch.autograd.grad(fused_loss(picture, target, 0.2, launches=launches)[0], picture, create_graph=True)
    assert not fused_loss(picture.detach(), target, 0.2, launches=launches)[0].requires_grad


def test_kernels_that_are_missing_are_told_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_: torch.device) -> Launches:
        raise BackendError("NVRTC fails: update torch")

    monkeypatch.setattr(losses, "compiled", refuse)
    losses._fuses.cache_clear()
    device = torch.device("cpu")
    assert [losses._fuses(device), losses._fuses(device)] == [False, False]
    assert caplog.text.count("NVRTC fails") == 1
    losses._fuses.cache_clear()


@pytest.mark.gpu
@pytest.mark.parametrize("size", [*SIZES, (1061, 1893)])
def test_on_a_gpu(size: tuple[int, int]) -> None:
    picture, target = (p.cuda().requires_grad_(n == 0) for n, p in enumerate(pictures(*size)))
    loss = picture_loss(picture, target, SSIM(data_range=1.0, channel=3).cuda(), 0.2)
    assert "_Loss" in type(loss.grad_fn).__name__
    (gradient,) = torch.autograd.grad(loss, picture)
    expected, slope = exact(picture.detach(), target, 0.2)
    assert loss.item() == pytest.approx(expected.item(), abs=2e-6)
    assert (gradient - slope).abs().max() < 2e-4 * slope.abs().max()
    base = pictures(*size, seed=1)[0].cuda().requires_grad_()
    both = picture_losses(picture, base, target, SSIM(data_range=1.0, channel=3), 0.2)
    assert both[1] is not None
    assert torch.equal(both[0], loss)
    assert both[1].item() == pytest.approx((base - target).abs().mean().item(), rel=1e-5)
    slopes = torch.autograd.grad(both[0] + both[1], (picture, base))
    assert torch.equal(slopes[0], gradient)
    torch.testing.assert_close(slopes[1], (base - target).sign() / base.numel())
    others = ((picture[:10], target[:10], 0.2), (picture, target, 0.0), (picture.double(), target.double(), 0.2))
    for *pair, weight in others:  # too small, without SSIM, in another precision
        elsewhere = picture_loss(*pair, SSIM(data_range=1.0, channel=3), weight)
        assert "_Loss" not in type(elsewhere.grad_fn).__name__
    again = torch.autograd.grad(picture_loss(picture, target, SSIM(data_range=1.0, channel=3), 0.2), picture)[0]
    assert torch.equal(again, gradient)
