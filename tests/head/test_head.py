"""The head: its network, its two modes and their invariances, training crops, and images at other scales."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.core.camera import Crop
from sundae_ns.core.errors import ConfigError
from sundae_ns.head.head import (
    FADE,
    MARGIN,
    MAX_PIXELS,
    SIZES,
    TOLERANCE,
    CompensationHead,
    HeadConfig,
    plan,
    resize,
    training_crop,
)
from sundae_ns.head.unet import UNet


def inputs(height=33, width=40):
    colors, alpha = torch.rand(height, width, 3), torch.rand(height, width, 1)
    splatted = torch.cat([colors, torch.randn(height, width, 5)], dim=2)
    return (colors + (1 - alpha) * 0.5).clamp(0, 1), splatted, alpha


def head(**options):
    return CompensationHead(HeadConfig(size="tiny", num_features=5, **options))


def perturb(module):
    """Move the zero start away from zero, as training does."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 0.1 * torch.randn_like(parameter)


def test_residual_starts_at_the_base_and_corrects_only_what_is_splatted():
    base, splatted, alpha = inputs()
    module = head()
    assert torch.equal(module(base, splatted, alpha), base)
    perturb(module)
    alpha[:10] = 0
    out = module(base, splatted, alpha)
    assert torch.equal(out[:10], base[:10])
    assert not torch.allclose(out[10:], base[10:])
    on_another_background = module(base + 0.1, splatted, alpha)
    torch.testing.assert_close(on_another_background - out, torch.full_like(out, 0.1), rtol=0, atol=1e-5)


def test_features_mode_sees_features_alone():
    base, splatted, alpha = inputs()
    module = head(mode="features")
    out = module(base, splatted, alpha)
    no_colors = torch.cat([torch.zeros_like(splatted[..., :3]), splatted[..., 3:]], dim=2)
    assert torch.equal(out, module(base * 0, no_colors, alpha * 0))
    assert not torch.equal(out, module(base, splatted + 1, alpha))


WILD = {
    "large": lambda t: 1e4 * t,
    "large and negative": lambda t: -1e4 * t,
    "zero": torch.zeros_like,
    "one spike": lambda t: t.index_fill(1, torch.tensor([7], device=t.device), 1e4),
}


@pytest.mark.parametrize("kind", WILD)
@pytest.mark.parametrize("mode", ["residual", "features"])
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_wild_inputs_give_finite_images(device, mode, kind):
    base, splatted, alpha = (value.to(device) for value in inputs())
    module = head(mode=mode).to(device)
    perturb(module)
    splatted = WILD[kind](splatted).requires_grad_()
    out = module(base, splatted, alpha)
    out.square().mean().backward()
    assert out.dtype == torch.float32
    assert torch.isfinite(out).all()
    assert torch.isfinite(splatted.grad).all()


def test_a_resized_head_keeps_its_parameter_objects():
    head = CompensationHead(HeadConfig(size="compact"))
    wanted = HeadConfig(size="tiny", num_features=5, pixel_unshuffle=1)
    optimizer, before = torch.optim.Adam(head.parameters(), lr=0.01), list(head.parameters())
    head.eval()
    head.resize(wanted)
    fresh = CompensationHead(wanted)
    assert all(a is b for a, b in zip(before, head.parameters(), strict=True))
    assert [p.shape for p in head.parameters()] == [p.shape for p in fresh.parameters()]
    assert str(head.net) == str(fresh.eval().net), "layers describe themselves"
    with pytest.raises(ConfigError, match="head.mode is off, which is no compensation head"):
        head.resize(HeadConfig(mode="off"))
    assert not any(module.training for module in head.modules())
    fresh.load_state_dict(head.state_dict())
    images = [torch.rand(9, 11, channels) for channels in (3, 3 + 5, 1)]
    assert torch.equal(head(*images), fresh(*images))
    head.train()(*images).square().mean().backward()
    optimizer.step()
    assert not torch.equal(head(*images), fresh(*images))


SIDES = st.integers(1, 5000)


@given(SIDES, SIDES, st.integers(1, 2**22), st.integers(0, 2**31))
def test_inside_the_image(width, height, limit, seed):
    crop = training_crop(width, height, limit, seed)
    assert (crop is None) == (width * height <= limit)
    if crop is None:
        return
    assert 0 <= crop.left < crop.left + crop.width <= width
    assert 0 <= crop.top < crop.top + crop.height <= height
    # A side of a window is at least the grid, however low the limit.
    assert crop.width * crop.height <= limit or min(crop.width, crop.height) <= 16


def test_windows_follow_the_seed_keep_the_aspect_use_the_limit_and_often_see_both_edges():
    assert training_crop(10_000, 10_000, 0, seed=1) is None
    crop, again, other = (training_crop(1061, 1893, 2**20, seed) for seed in (3, 3, 4))
    assert crop == again != other
    assert crop.width / crop.height == pytest.approx(1061 / 1893, rel=0.03)
    assert 0.95 * 2**20 < crop.width * crop.height <= 2**20
    seen = np.zeros(1000)
    for crop in (training_crop(1000, 1000, 490_000, seed) for seed in range(2000)):
        seen[crop.left : crop.left + crop.width] += 1
    assert seen.min() > 0.3 * seen.max()
    assert abs(seen - seen[::-1]).max() < 0.1 * seen.max()


def test_half_of_the_windows_are_mirrored_if_asked():
    """Whole images and parts, with the same places as without."""
    for limit in (0, 900):
        plain = [training_crop(40, 30, limit, seed) for seed in range(400)]
        both = [training_crop(40, 30, limit, seed, mirror=True) for seed in range(400)]
        assert 160 < len([crop for crop in both if crop is not None and crop.mirrored]) < 240
        for before, after in zip(plain, both, strict=True):
            whole = Crop(0, 0, 40, 30) if before is None else before
            assert (whole if after is None else after._replace(mirrored=False)) == whole


FOCAL = st.floats(1.0, 1e5)


@given(FOCAL, FOCAL, FOCAL)
def test_the_head_runs_near_its_own_scale(focal, a, b):
    low, high = min(a, b), max(a, b)
    zoom, weight = plan(focal, (low, high), 100)
    assert 0 <= weight <= 1
    assert low / (TOLERANCE + 1e-6) <= focal * zoom <= high * (TOLERANCE + 1e-6)
    if low <= focal <= high:
        assert (zoom, weight) == (1.0, 1.0)
    assert plan(focal * zoom, (low, high), 10**9) == (1.0, 1.0)  # an image at the head's scale is not rescaled
    assert plan(focal, None, 10**9) == (1.0, 1.0)
    for near in (900.0, 980.0, 1020.0, 1100.0):
        assert plan(near, (1000.0, 1000.0), 100) == (1000.0 / near, 1.0)


def test_the_head_fades_out_without_a_jump():
    """For thumbnails, and for wide views with too many pixels at the trained scale."""
    shrunk = [plan(1000 / shrink, (1000.0, 1000.0), 100).weight for shrink in np.linspace(1.3, 5, 200)]
    wide = [plan(1000.0, (1950.0, 1950.0), int(size)).weight for size in np.linspace(2**18, 1.1 * 2**23, 400)]
    for weights in (shrunk, wide):
        assert (weights[0], weights[-1]) == (1, 0)
        assert all(0 <= a - b < 0.02 for a, b in zip(weights, weights[1:], strict=False))
    assert plan(1000 / FADE[0], (1000.0, 1000.0), 100).weight == 0
    assert plan(1000.0, (250.0, 250.0), 4000 * 3000).weight == 1  # a large image that is rescaled to a smaller one
    assert plan(1000.0, (1000 * MARGIN, 1000 * MARGIN), 10**9).weight == 1
    assert plan(1000.0, (1010 * MARGIN, 1010 * MARGIN), 2 * MAX_PIXELS).weight < 1


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (40, 64), (31, 90)])
def test_resizing_keeps_the_mean(size):
    image = torch.rand(16, 24, 3, generator=torch.Generator().manual_seed(0))
    out = resize(image, *size)
    assert out.shape == (*size, 3)
    assert out.mean() == pytest.approx(float(image.mean()), abs=0.03)
    assert torch.equal(resize(image, 16, 24), image)


def test_the_papers_size_and_a_limited_width():
    net = UNet(3, 3, SIZES["regular"][0])
    assert 4 * sum(p.numel() for p in net.parameters()) / 2**20 == pytest.approx(30, rel=0.04)
    net = UNet(3, 3, 8, max_width=16)
    assert {p.shape[0] for p in net.encoder.parameters()} == {8, 16}
    assert net(torch.rand(1, 3, 20, 24)).shape == (1, 3, 20, 24)


@pytest.mark.parametrize("unshuffle", [1, 2, 4])
@pytest.mark.parametrize(("height", "width"), [(30, 30), (31, 47), (1, 1), (64, 5)])
def test_any_size(unshuffle, height, width):
    image = torch.rand(1, 5, height, width)
    out = UNet(5, 3, 4, pixel_unshuffle=unshuffle)(image)
    assert out.shape == (1, 3, height, width)
    assert out.isfinite().all()
    assert torch.equal(UNet(5, 3, 4, pixel_unshuffle=unshuffle, zero_init=True)(image), torch.zeros_like(out))


def test_padding_affects_the_edge_only():
    """An image cropped to an odd size keeps its values far from the crop."""
    net = UNet(3, 3, 8)
    image = torch.rand(1, 3, 128, 128)
    full, cropped = net(image), net(image[..., :117, :115])
    assert cropped.shape[-2:] == (117, 115)
    assert torch.allclose(cropped[..., :24, :24], full[..., :24, :24], atol=1e-6)
    assert not torch.allclose(cropped[..., -4:, -4:], full[..., 113:117, 111:115], atol=1e-6)
