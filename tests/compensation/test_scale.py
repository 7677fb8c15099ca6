"""Images at other scales than the head was trained at: the plan, and the resizing of corrections."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.compensation import plan, resize
from sundae_ns.compensation.scale import FADE, MARGIN, MAX_PIXELS, TOLERANCE

FOCAL = st.floats(1.0, 1e5)


@pytest.mark.parametrize("focal", [500.0, 1.0])
def test_unknown_scale_is_left_unchanged(focal: float) -> None:
    assert plan(focal, None, 10**9) == (1.0, 1.0)


@given(FOCAL, FOCAL, FOCAL)
def test_the_head_runs_near_its_own_scale(focal: float, a: float, b: float) -> None:
    low, high = min(a, b), max(a, b)
    zoom, weight = plan(focal, (low, high), 100)
    assert 0 <= weight <= 1
    assert low / (TOLERANCE + 1e-6) <= focal * zoom <= high * (TOLERANCE + 1e-6)
    if low <= focal <= high:
        assert (zoom, weight) == (1.0, 1.0)
    assert plan(focal * zoom, (low, high), 10**9) == (1.0, 1.0)  # an image at the head's scale is not rescaled


def test_a_scale_near_the_trained_one_gets_its_correction() -> None:
    assert plan(1000.0, (1000.0, 1000.0), 100) == (1.0, 1.0)
    for focal in (900.0, 980.0, 1020.0, 1100.0):
        assert plan(focal, (1000.0, 1000.0), 100) == (1000.0 / focal, 1.0)


def test_thumbnails_fade_out_without_a_jump() -> None:
    shrinks = torch.linspace(1.3, 5, 200).tolist()
    weights = [plan(1000 / shrink, (1000.0, 1000.0), 100).weight for shrink in shrinks]
    assert weights[0] == 1
    assert weights[-1] == 0
    assert all(a >= b for a, b in zip(weights, weights[1:], strict=False))
    assert max(a - b for a, b in zip(weights, weights[1:], strict=False)) < 0.02
    assert plan(1000 / FADE[0], (1000.0, 1000.0), 100).weight == 0


def test_a_wide_view_is_not_rescaled_beyond_the_pixel_limit() -> None:
    """At almost twice the scale an image has almost four times the pixels."""
    sizes = torch.linspace(2**18, 1.1 * 2**23, 400).tolist()
    weights = [plan(1000.0, (1950.0, 1950.0), int(pixels)).weight for pixels in sizes]
    assert weights[0] == 1
    assert weights[-1] == 0
    assert all(a >= b for a, b in zip(weights, weights[1:], strict=False))
    assert max(a - b for a, b in zip(weights, weights[1:], strict=False)) < 0.02
    assert plan(1000.0, (250.0, 250.0), 4000 * 3000).weight == 1  # a large image that is rescaled to a smaller one


@given(st.integers(1, 10**9), st.floats(0.1, 5.0))
def test_the_head_fades_in_at_any_size(pixels: int, zoom: float) -> None:
    weight = plan(1000.0, (1000 * zoom, 1000 * zoom), pixels).weight
    assert abs(weight - plan(1000.0, (1010 * zoom, 1010 * zoom), pixels).weight) < 0.08
    if zoom <= MARGIN:
        assert weight == 1
    elif pixels * zoom**2 > 2 * max(MAX_PIXELS, MARGIN**2 * pixels):
        assert weight == 0


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (40, 64), (31, 90)])
def test_resizing_keeps_the_mean(size: tuple[int, int]) -> None:
    image = torch.rand(16, 24, 3, generator=torch.Generator().manual_seed(0))
    out = resize(image, *size)
    assert out.shape == (*size, 3)
    assert out.mean() == pytest.approx(float(image.mean()), abs=0.03)
    assert torch.equal(resize(image, 16, 24), image)
