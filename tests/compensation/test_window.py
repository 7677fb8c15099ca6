"""Training windows: inside the image, within the limit, covering every part, deterministic by seed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.compensation import Window, training_window

SIDES = st.integers(1, 5000)


@given(SIDES, SIDES, st.integers(1, 2**22), st.integers(0, 2**31))
def test_inside_the_image(width: int, height: int, limit: int, seed: int) -> None:
    window = training_window(width, height, limit, seed)
    assert (window is None) == (width * height <= limit)
    if window is None:
        return
    assert 0 <= window.left <= window.left + window.width <= width
    assert 0 <= window.top <= window.top + window.height <= height
    assert 1 <= window.width
    assert 1 <= window.height
    # A side of a window is at least the grid, however low the limit.
    assert window.width * window.height <= limit or min(window.width, window.height) <= 16


def test_no_limit() -> None:
    assert training_window(10_000, 10_000, 0, seed=1) is None


def test_determined_by_the_seed() -> None:
    windows = [training_window(1061, 1893, 2**20, seed) for seed in (3, 3, 4)]
    assert windows[0] == windows[1] != windows[2]


def test_windows_keep_the_aspect_and_use_the_limit() -> None:
    window = training_window(1061, 1893, 2**20, seed=0)
    assert window is not None
    assert window.width / window.height == pytest.approx(1061 / 1893, rel=0.03)
    assert 0.95 * 2**20 < window.width * window.height <= 2**20


def test_both_edges_are_seen_often() -> None:
    seen = np.zeros(1000)
    for seed in range(2000):
        window = training_window(1000, 1000, 490_000, seed)
        assert window is not None
        seen[window.left : window.left + window.width] += 1
    assert seen.min() > 0.3 * seen.max()
    assert abs(seen - seen[::-1]).max() < 0.1 * seen.max()


def test_half_of_the_windows_are_mirrored_if_asked() -> None:
    """Whole images and parts, with the same places as without."""
    for limit in (0, 900):
        plain = [training_window(40, 30, limit, seed) for seed in range(400)]
        both = [training_window(40, 30, limit, seed, mirror=True) for seed in range(400)]
        mirrored = [window for window in both if window is not None and window.mirrored]
        assert 160 < len(mirrored) < 240
        for before, after in zip(plain, both, strict=True):
            whole = Window(0, 0, 40, 30) if before is None else before
            assert (whole if after is None else after._replace(mirrored=False)) == whole
