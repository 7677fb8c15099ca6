"""Error bounds of every attribute, for ordinary and extreme values."""

import numpy as np
import pytest
import torch
from hard_values import KINDS, drifted, hard_values
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.core.covariance import covariances
from sundae_ns.io import coordinates
from sundae_ns.io.pack import entropy, quantize

hard = given(st.sampled_from(KINDS), st.integers(1, 700), st.integers(0, 2**16))


def ulp(x):
    """Unit in the last place of float32: the rounding of the result and of a product before it."""
    return np.spacing(np.abs(x).astype(np.float32)).astype(np.float64)


@hard
def test_separate_inverts_interleave(kind, n, seed):
    cells = np.random.default_rng(seed).integers(0, 2**coordinates.MAX_BITS, (n, 3)).astype(np.uint64)
    codes = coordinates.interleave(cells)
    for axis in range(3):
        assert np.array_equal(coordinates.separate(codes, axis), cells[:, axis])
    assert sorted(coordinates.scene_order(hard_values(kind, n, 3, seed))) == list(range(n))


def test_scene_order_keeps_neighbours_together_despite_a_far_primitive():
    means = np.random.default_rng(0).random((4096, 3)).astype(np.float32)
    means[7] = 1e6
    ordered = np.delete(means, 7, axis=0)[coordinates.scene_order(np.delete(means, 7, axis=0))]
    with_far = means[coordinates.scene_order(means)]
    steps = [np.median(np.linalg.norm(np.diff(m, axis=0), axis=1)) for m in (means, ordered, with_far)]
    assert steps[1] < steps[0] / 5
    assert steps[2] < 1.5 * steps[1]


@hard
def test_positions(kind, n, seed):
    bits, size = 4 + seed % 13, 16 + seed % 200
    x = hard_values(kind, n, 3, seed)
    x = x[coordinates.scene_order(x)]
    packed, order = quantize.quantize_positions(x, bits, size)
    assert sorted(order) == list(range(n))
    found = quantize.dequantize_positions(packed, bits, size).astype(np.float64)
    half = (packed.high.astype(np.float64) - packed.low) / (2**bits - 1) / 2
    block = np.arange(n) // size
    assert (np.abs(found - x[order]) <= half[block] * (1 + 1e-9) + ulp(x[order])).all()
    starts = np.arange(1, n) % size == 0
    assert ((packed.codes[1:] >= packed.codes[:-1]) | starts).all()
    assert (packed.codes < np.uint64(1 << 3 * bits)).all()


def test_a_far_primitive_does_not_increase_the_error_of_others():
    x = np.random.default_rng(0).random((5000, 3)).astype(np.float32)
    x[3] = 1e6
    packed, order = quantize.quantize_positions(x[coordinates.scene_order(x)], 16, 1024)
    found = quantize.dequantize_positions(packed, 16, 1024)
    truth = x[coordinates.scene_order(x)][order]
    assert np.quantile(np.abs(found - truth).max(axis=1), 0.79) < 1 / 65535 / 2 + 1e-7


def angles(a, b):
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    near = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4 * np.arcsin(np.minimum(near / 2, 1))


def through_rotations(q, step):
    """Quaternions after a round trip, of axes turned for the smallest rotation."""
    turned, _ = quantize.aligned(q, np.zeros((len(q), 3), np.float32))
    _, levels, _ = quantize.Rotations(step).encode(turned)
    return quantize.rotations_at(torch.from_numpy(levels), step).numpy()


def hard_quaternions(n, seed, length):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    q[rng.random(n) < 0.2] = rng.choice([-0.5, 0.5], size=4)  # corners, where all four are the largest
    q[rng.random(n) < 0.1] = [0, 0, -1, 0]
    return (q * length).astype(np.float32)


@given(st.integers(1, 300), st.integers(0, 2**16), st.sampled_from([1e-15, 1.0, 1e15]))
def test_aligned_ellipsoids_are_the_same(n, seed, length):
    q, scales = hard_quaternions(n, seed, length), hard_values("normal", n, 3, seed)
    turned, moved = quantize.aligned(q, scales)
    pairs = [[torch.from_numpy(each).double() for each in pair] for pair in ((turned, moved), (q, scales))]
    after, before = (covariances(logs.exp(), quats / quats.norm(dim=1, keepdim=True)) for quats, logs in pairs)
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-5)
    assert (turned[:, 0] > 0.853).all()  # cos(62.8 degrees / 2)
    assert np.array_equal(np.sort(moved), np.sort(scales))


@given(st.integers(1, 500), st.integers(0, 2**16), st.sampled_from([1e-4, 0.008, 0.1, 1.0]))
def test_rotations(n, seed, step):
    q = hard_quaternions(n, seed, 1.0)
    turned, _ = quantize.aligned(q, np.zeros((n, 3), np.float32))
    found = through_rotations(q, step)
    assert np.array_equal(quantize.Rotations(step).rounded(torch.from_numpy(turned)).numpy(), found)
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    if step < 0.5:
        assert angles(turned.astype(np.float64), found.astype(np.float64)).max() <= quantize.rotation_bound(step) + 2e-6


def test_the_bound_of_rotations_is_nearly_reached():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(100_000, 4)).astype(np.float32)
    turned, _ = quantize.aligned(q, np.zeros((len(q), 3), np.float32))
    worst = angles(turned.astype(np.float64), through_rotations(q, 0.01).astype(np.float64)).max()
    assert 0.85 * quantize.rotation_bound(0.01) < worst <= quantize.rotation_bound(0.01)


def test_a_quaternion_of_length_zero_is_the_identity():
    assert np.array_equal(through_rotations(np.zeros((2, 4), np.float32), 0.01), [[1, 0, 0, 0]] * 2)


@hard
def test_weights(kind, n, seed):
    x = hard_values(kind, n, 18, seed).reshape(n, 2, 3, 3)
    steps = quantize.weight_steps(torch.from_numpy(x), 1 / 127)[:, None]
    found = quantize.weights_at(quantize.weight_levels(torch.from_numpy(x), steps), steps)
    error, step = np.abs(found.double().numpy() - x).reshape(n, -1), steps.numpy()[:, 0]
    assert (error <= step[:, None] / 2 * (1 + 1e-6) + ulp(x.reshape(n, -1))).all()
    assert (step <= np.abs(x.reshape(n, -1)).max(axis=1) / 127 * (1 + 1e-6) + 1e-44).all()


@hard
def test_transform(kind, n, seed):
    x = hard_values(kind, n, 9, seed)
    codec = quantize.fit_transform(x, 0.03)
    for values in (drifted(x, seed), x):  # rounding is what a reader decodes, bit for bit
        _, levels, arrays = codec.encode(values)
        arrays["basis"] = arrays["basis"].reshape(9, 9)
        found = quantize.rows_at(levels, step=codec.step, **arrays).astype(np.float64)
        assert np.array_equal(codec.rounded(torch.from_numpy(values)).numpy(), found)
        assert np.abs(levels).max() <= entropy.LARGEST
    # Sums of nine products in float32.
    slack = 20 * ulp(np.linalg.norm(x.astype(np.float64), axis=1, keepdims=True))
    assert (np.abs(found - x) <= codec.bound + slack).all()
    assert codec.bound < codec.step / 2 * 3.2
    if np.abs(x).max() < 1000:
        assert codec.step == 0.03


@pytest.mark.parametrize("kind", ["normal", "outliers"])
def test_a_transform_decorrelates_columns(kind):
    rng = np.random.default_rng(0)
    x = np.repeat(hard_values(kind, 2000, 3, 0), 3, axis=1) + 0.001 * rng.normal(size=(2000, 9)).astype(np.float32)
    x = x.astype(np.float32)
    _, levels, _ = quantize.fit_transform(x, 0.03, centred=False).encode(x)
    zeros = (levels == 0).mean(axis=0)
    assert (zeros[3:] > 0.98).all()
    assert (zeros[:3] < 0.2).all()


def test_rows_of_zeros_stay_exact():
    x = hard_values("normal", 200, 9, 0) + 1
    x[::2] = 0
    codec = quantize.fit_transform(x, 0.03, centred=False)
    assert not codec.rounded(torch.from_numpy(x))[::2].any()


def test_a_form_makes_errors_that_show_smaller():
    """At as many bits: less than half of the errors by the form, and larger errors in its least direction."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(4000, 6)).astype(np.float32)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    form = axes * np.array([1, 1, 1, 0.1, 0.1, 0.02]) @ axes.T
    plain, weighted = quantize.fit_transform(x, 0.1), quantize.fit_transform(x, 0.1, form=torch.from_numpy(form))
    errors = [codec.rounded(torch.from_numpy(x)).double().numpy() - x for codec in (plain, weighted)]
    seen = [np.einsum("ni,ij,nj->n", error, form, error).mean() for error in errors]
    bits = [np.log2(1 + np.abs(codec.encode(x)[1])).mean() for codec in (plain, weighted)]
    assert bits[1] < bits[0]
    assert 0.5 < seen[1] / (0.1**2 / 12 * np.trace(form)) < 1.3
    assert np.abs(errors[1] @ axes[:, 5]).mean() > 1.5 * np.abs(errors[0] @ axes[:, 5]).mean()
    identity = quantize.fit_transform(x, 0.1, form=torch.eye(6, dtype=torch.float64) * 7)
    assert np.abs(identity.rounded(torch.from_numpy(x)).numpy() - x).max() < identity.bound * (1 + 1e-5)
