import math
import urllib.error
import urllib.request

import pytest
import torch
from skimage.metrics import structural_similarity

from sundae_ns.core.errors import DataError
from sundae_ns.core.metrics import MOST_PSNR, Lpips, fitted_psnr, lpips_weights, psnr, quality_of, ssim


def _pair(height=40, width=30, noise=0.1):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    return (target + noise * torch.randn(target.shape, generator=generator, dtype=torch.float64)).clamp(0, 1), target


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


def test_ssim_is_that_of_scikit_image():
    pred, target = _pair()
    options = {"gaussian_weights": True, "use_sample_covariance": False, "data_range": 1.0, "channel_axis": 2}
    expected = structural_similarity(pred.numpy(), target.numpy(), **options)
    assert ssim(pred, target).item() == pytest.approx(expected, abs=1e-6)
    assert ssim(target, target).item() == pytest.approx(1.0)
    assert ssim(*_pair(11, 11)).isfinite(), "the smallest image that has one"
    for size in ((10, 40), (40, 10), (1, 1)):
        assert ssim(*_pair(*size)).isnan()
        assert psnr(*_pair(*size)).isfinite()


@pytest.mark.parametrize("metric", [psnr, ssim])
@pytest.mark.parametrize("shape", [(4, 5), (3, 4, 5), (1, 4, 5, 3)])
def test_wrong_shapes(metric, shape):
    with pytest.raises(DataError, match="shapes"):
        metric(torch.zeros(shape), torch.zeros(shape))
    with pytest.raises(DataError, match="shapes"):
        metric(torch.zeros(20, 20, 3), torch.zeros(20, 21, 3))


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """An empty torch.hub folder, and the time limits of requests, none of which is answered."""
    limits = []

    def refuse(*_, timeout):
        limits.append(timeout)
        raise urllib.error.URLError("no network")

    monkeypatch.setattr(urllib.request, "urlopen", refuse)
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))
    return limits


def test_without_weights_or_with_damaged_ones_there_is_one_warning_and_no_error(hub, caplog):
    metric, image = Lpips(), torch.rand(40, 40, 3)
    small = image[:31]  # images without an LPIPS need no weights
    assert (metric(small, small), hub, caplog.records) == (None, [], [])
    assert [metric(image, image) for _ in range(3)] == [None] * 3
    (limit,), (message,), (url, path) = hub, caplog.messages, lpips_weights()
    assert 0 < limit <= 10
    for words in ("no network", url, str(path.parent)):
        assert words in message
    assert "\n" not in message
    path.parent.mkdir(parents=True)
    path.write_bytes(b"not a checkpoint")
    assert Lpips()(image, image) is None
    assert (len(caplog.records), len(hub)) == (2, 1)


def test_weights_on_disk_are_used_without_the_network(hub):
    from torchvision.models import alexnet

    torch.manual_seed(0)
    _, path = lpips_weights()
    path.parent.mkdir(parents=True)
    # The file's name carries a hash, but torch.hub checks it only while downloading.
    torch.save(alexnet(weights=None).state_dict(), path)
    metric, target = Lpips(), torch.rand(32, 48, 3)
    same, near, far = (metric(target + noise * torch.randn(32, 48, 3), target) for noise in (0, 0.05, 0.5))
    assert hub == []
    assert same == 0
    assert 0 < near < far
    assert not far.requires_grad
    assert metric(target, target) == 0  # earlier calls leave no state


def test_quality_has_what_can_be_measured():
    image, truth = _pair()
    found = quality_of(image.float(), truth.float(), lambda *_: None)
    assert found.lpips is None
    assert found.psnr == pytest.approx(float(psnr(image, truth)), abs=1e-4)
    assert found.psnr_fitted >= found.psnr
    assert quality_of(image, truth, lambda *_: torch.tensor(0.5)).lpips == 0.5
