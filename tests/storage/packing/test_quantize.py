"""Error bounds of every attribute, for ordinary and extreme values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hard_values import KINDS, hard_values
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sundae_ns.storage.packing import morton, quantize, transform
from sundae_ns.storage.packing.container import Floats

hard = given(st.sampled_from(KINDS), st.integers(1, 700), st.integers(0, 2**16))


def ulp(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit in the last place of float32: the rounding of the result and of a product before it."""
    return np.spacing(np.abs(x).astype(np.float32)).astype(np.float64)


@hard
def test_separate_inverts_interleave(kind: str, n: int, seed: int) -> None:
    cells = np.random.default_rng(seed).integers(0, 2**morton.MAX_BITS, (n, 3)).astype(np.uint64)
    codes = morton.interleave(cells)
    for axis in range(3):
        assert np.array_equal(morton.separate(codes, axis), cells[:, axis])
    assert sorted(morton.scene_order(hard_values(kind, n, 3, seed))) == list(range(n))


def test_scene_order_keeps_neighbours_together_despite_a_far_primitive() -> None:
    means = np.random.default_rng(0).random((4096, 3)).astype(np.float32)
    means[7] = 1e6
    ordered = np.delete(means, 7, axis=0)[morton.scene_order(np.delete(means, 7, axis=0))]
    with_far = means[morton.scene_order(means)]
    steps = [np.median(np.linalg.norm(np.diff(m, axis=0), axis=1)) for m in (means, ordered, with_far)]
    assert steps[1] < steps[0] / 5
    assert steps[2] < 1.5 * steps[1]


def through_uniform(x: Floats, codec: quantize.Uniform) -> tuple[Floats, Floats]:
    """Values after a round trip, and the exceptions."""
    _, arrays = replace(codec, differences=False).encode(x)
    return quantize.dequantize(low=codec.low.numpy(), step=codec.step.numpy(), **arrays), arrays["exceptions"]


@hard
def test_uniform(kind: str, n: int, seed: int) -> None:
    x = hard_values(kind, n, 3, seed)
    bits = 4 + seed % 13
    for color in (False, True):
        codec = quantize.fit_uniform(x, bits, color=color)
        found, exact = through_uniform(x, codec)
        error = np.abs(found.astype(np.float64) - x)
        assert (error <= codec.step.numpy() / 2 * (1 + 1e-9) + ulp(x)).all()
        assert len(exact) <= 2 * quantize.TAIL * x.size + 6


def test_outliers_do_not_widen_the_range() -> None:
    x = np.random.default_rng(0).normal(size=(10_000, 1)).astype(np.float32)
    clean = quantize.fit_uniform(x, 8).step
    x[17], x[18] = 1e6, -1e9
    codec = quantize.fit_uniform(x, 8)
    assert codec.step <= clean
    assert np.array_equal(through_uniform(x, codec)[0][17:19], x[17:19])


@hard
def test_positions(kind: str, n: int, seed: int) -> None:
    bits, size = 4 + seed % 18, 16 + seed % 200
    x = hard_values(kind, n, 3, seed)
    x = x[morton.scene_order(x)]
    packed, order = quantize.quantize_positions(x, bits, size)
    assert sorted(order) == list(range(n))
    found = quantize.dequantize_positions(packed, bits, size).astype(np.float64)
    half = (packed.high.astype(np.float64) - packed.low) / (2**bits - 1) / 2
    block = np.arange(n) // size
    assert (np.abs(found - x[order]) <= half[block] * (1 + 1e-9) + ulp(x[order])).all()
    # Each block is sorted, so the differences of its codes are not negative.
    inner = np.arange(n) % size != 0
    assert (packed.deltas[inner] < np.uint64(1 << 3 * bits)).all()


def test_a_far_primitive_does_not_increase_the_error_of_others() -> None:
    x = np.random.default_rng(0).random((5000, 3)).astype(np.float32)
    x[3] = 1e6
    packed, order = quantize.quantize_positions(x[morton.scene_order(x)], 16, 1024)
    found = quantize.dequantize_positions(packed, 16, 1024)
    truth = x[morton.scene_order(x)][order]
    assert np.quantile(np.abs(found - truth).max(axis=1), 0.79) < 1 / 65535 / 2 + 1e-7


def angles(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles between rotations, radians, exact for small ones too."""
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    near = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4 * np.arcsin(np.minimum(near / 2, 1))


def through_rotations(q: Floats, bits: int) -> Floats:
    _, arrays = quantize.Rotations(bits).encode(q)
    return quantize.dequantize_rotations(arrays["codes"], arrays["largest"], bits)


@given(st.integers(1, 500), st.integers(0, 2**16), st.integers(4, 16), st.sampled_from([1e-30, 1.0, 1e30]))
def test_rotations(n: int, seed: int, bits: int, length: float) -> None:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    q[rng.random(n) < 0.2] = rng.choice([-0.5, 0.5], size=4)  # corners, where all four are the largest
    q[rng.random(n) < 0.1] = [0, 0, -1, 0]
    q = (q * length).astype(np.float32)
    found = through_rotations(q, bits)
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    assert angles(q.astype(np.float64), found.astype(np.float64)).max() <= quantize.rotation_bound(bits) + 2e-6


def test_the_bound_of_rotations_is_nearly_reached() -> None:
    rng = np.random.default_rng(0)
    corner = np.full((100_000, 4), 0.5) + rng.normal(size=(100_000, 4)) * 0.01
    for bits in (8, 10):  # 0.94 and 0.95 of the bound
        found = through_rotations(corner.astype(np.float32), bits)
        worst = angles(corner, found.astype(np.float64)).max()
        assert 0.9 * quantize.rotation_bound(bits) < worst <= quantize.rotation_bound(bits)


def test_a_quaternion_of_length_zero_is_the_identity() -> None:
    found = through_rotations(np.zeros((2, 4), np.float32), 8)
    assert np.allclose(found, [1, 0, 0, 0], atol=quantize.rotation_bound(8))


@hard
def test_weights(kind: str, n: int, seed: int) -> None:
    x = hard_values(kind, n, 18, seed).reshape(n, 2, 3, 3)
    steps = quantize.weight_steps(torch.from_numpy(x), 8)
    found = quantize.weights_at(quantize.weight_levels(torch.from_numpy(x), steps, 8), steps)
    error, step = np.abs(found.double().numpy() - x).reshape(n, -1), steps.numpy()
    assert (error <= step[:, None] / 2 * (1 + 1e-6) + ulp(x.reshape(n, -1))).all()
    assert (step <= np.abs(x.reshape(n, -1)).max(axis=1) / 127 * (1 + 1e-6) + 1e-44).all()


@hard
def test_transform(kind: str, n: int, seed: int) -> None:
    x = hard_values(kind, n, 9, seed)
    codec = transform.fit(x, 0.03)
    _, arrays = codec.encode(x)
    arrays["basis"] = arrays["basis"].reshape(9, 9)
    found, rows = transform.restore(step=codec.step, **arrays).astype(np.float64), arrays["rows"]
    assert np.array_equal(found[rows].astype(np.float32), x[rows])
    # Sums of nine products in float32.
    slack = 20 * ulp(np.linalg.norm(x.astype(np.float64), axis=1, keepdims=True))
    assert (np.abs(found - x) <= codec.bound + slack).all()
    assert codec.bound < 0.03 / 2 * 3.2


@pytest.mark.parametrize("kind", ["normal", "outliers"])
def test_a_transform_decorrelates_columns(kind: str) -> None:
    rng = np.random.default_rng(0)
    x = np.repeat(hard_values(kind, 2000, 3, 0), 3, axis=1) + 0.001 * rng.normal(size=(2000, 9)).astype(np.float32)
    x = x.astype(np.float32)
    _, arrays = transform.fit(x, 0.03).encode(x)
    zeros = (arrays["codes"] == 0).mean(axis=1)
    assert (zeros[3:] > 0.98).all()
    assert (zeros[:3] < 0.2).all()
