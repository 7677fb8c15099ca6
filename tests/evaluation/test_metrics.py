import math

import pytest
import torch
from scipy.ndimage import correlate1d

from sundae_ns.errors import DataError
from sundae_ns.evaluation import fitted_psnr, psnr, ssim
from sundae_ns.evaluation.metrics import MOST_PSNR


def _pair(height=40, width=30, noise=0.1):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    return (target + noise * torch.randn(target.shape, generator=generator, dtype=torch.float64)).clamp(0, 1), target


def _ssim_by_definition(x, y):
    """Wang et al. 2004: Gaussian window of 11 pixels and sigma 1.5, kept where it fits inside the image."""
    window = [math.exp(-(i**2) / (2 * 1.5**2)) for i in range(-5, 6)]
    window = [w / sum(window) for w in window]

    def local_mean(image):
        blurred = correlate1d(correlate1d(image, window, axis=0), window, axis=1)
        return blurred[5:-5, 5:-5]

    x, y = x.numpy(), y.numpy()
    mx, my = local_mean(x), local_mean(y)
    vx, vy, cov = local_mean(x * x) - mx**2, local_mean(y * y) - my**2, local_mean(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (((2 * mx * my + c1) * (2 * cov + c2)) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean()


def test_psnr_of_a_known_error():
    target = torch.full((4, 5, 3), 0.5)
    assert psnr(target + 0.1, target).item() == pytest.approx(20.0, abs=1e-4)
    assert psnr(target, target).item() == math.inf


def test_a_fit_of_colours_takes_away_what_light_and_exposure_change():
    image, target = _pair()
    mask = torch.rand(target.shape[:2], generator=torch.Generator().manual_seed(1)) > 0.3
    mix = torch.tensor([[0.7, 0.1, 0.0], [0.0, 0.8, 0.1], [0.05, 0.0, 0.6]], dtype=target.dtype)
    changed = target @ mix + 0.1
    assert psnr(changed, target) < 30
    assert 60 < fitted_psnr(changed, target, mask) <= MOST_PSNR
    assert fitted_psnr(target, target) == MOST_PSNR
    # What no map of colours explains stays, and a fit loses nothing.
    assert fitted_psnr(image, target) >= psnr(image, target) - 1e-3
    assert fitted_psnr(target[..., [2, 0, 1]].flip(0), target) < 30
    grey = torch.full_like(target, 0.5)
    expected = -10 * math.log10(float((target - target.mean((0, 1))).square().mean()))
    assert fitted_psnr(grey, target).item() == pytest.approx(expected, abs=1e-2)
    assert math.isnan(fitted_psnr(torch.full_like(target, torch.nan), target))


def test_ssim_follows_the_definition():
    pred, target = _pair()
    assert ssim(pred, target).item() == pytest.approx(_ssim_by_definition(pred, target), abs=1e-6)
    assert ssim(target, target).item() == pytest.approx(1.0)


def test_smallest_image_with_an_ssim():
    assert ssim(*_pair(11, 11)).isfinite()
    for size in ((10, 40), (40, 10), (1, 1)):
        assert ssim(*_pair(*size)).isnan()
        assert psnr(*_pair(*size)).isfinite()


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_gradient_and_dtype(metric):
    pred, target = _pair()
    value = metric(pred.requires_grad_(), target)
    assert value.shape == ()
    assert value.dtype == torch.float64
    value.backward()
    assert pred.grad.abs().sum() > 0
    better = (pred + 1e-3 * pred.grad / pred.grad.norm()).detach()
    assert metric(better, target) > value


@pytest.mark.parametrize("metric", [psnr, ssim])
@pytest.mark.parametrize("shape", [(4, 5), (3, 4, 5), (1, 4, 5, 3)])
def test_wrong_shapes(metric, shape):
    with pytest.raises(DataError, match="shapes"):
        metric(torch.zeros(shape), torch.zeros(shape))
    with pytest.raises(DataError, match="shapes"):
        metric(torch.zeros(20, 20, 3), torch.zeros(20, 21, 3))
