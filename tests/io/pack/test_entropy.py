"""The entropy coder: every number comes back, sizes are near the entropy, and no stream breaks the decoder."""

import hashlib
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.io.coordinates import interleave
from sundae_ns.io.pack import entropy

LARGEST = entropy.LARGEST


def cells_of(n, bits, block, seed):
    codes = interleave(np.random.default_rng(seed).integers(0, 2**bits, (n, 3)).astype(np.uint64))
    for start in range(0, n, block):
        codes[start : start + block].sort()
    return codes


@given(st.integers(0, 300), st.integers(1, 6), st.integers(0, 2**16))
def test_numbers_come_back(n, width, seed):
    rng = np.random.default_rng(seed)
    levels = np.rint(rng.laplace(size=(n, width)) * 10 ** rng.uniform(-1, 6, width)).astype(np.int32)
    levels[rng.random((n, width)) < 0.02] = rng.choice([-LARGEST, LARGEST])
    levels = levels.clip(-LARGEST, LARGEST)
    near = entropy.neighbours_of(np.random.default_rng(seed).integers(0, 99, (n, 3)), 1 + seed % 50)
    assert np.array_equal(entropy.decode_levels(entropy.encode_levels(levels, near), width, near), levels)


@given(st.integers(1, 300), st.integers(4, 16), st.integers(0, 2**16))
def test_codes_of_cells_come_back(n, bits, seed):
    block = 16 + seed % 100
    codes = cells_of(n, bits, block, seed)
    codes[0] = 0
    codes[-1] = (1 << 3 * bits) - 1
    assert np.array_equal(entropy.decode_gaps(entropy.encode_gaps(codes, block, bits), n, block, bits), codes)


@pytest.mark.parametrize("scale", [0.02, 0.3, 4.0, 300.0])
def test_sizes_are_near_the_entropy(scale):
    levels = np.rint(np.random.default_rng(0).laplace(size=(20_000, 2)) * scale).astype(np.int32)
    _, counts = np.unique(levels, return_counts=True)
    entropy_of = -np.sum(counts / counts.sum() * np.log2(counts / counts.sum()))
    stream = entropy.encode_levels(levels, entropy.predecessors(len(levels)))
    assert 8 * len(stream) < (1.03 * entropy_of + 0.02) * levels.size


def test_contexts_use_neighbours():
    rng = np.random.default_rng(0)
    cells = rng.integers(0, 64, (4000, 3)).astype(np.uint64)
    cells = cells[np.argsort(interleave(cells))]
    near = entropy.neighbours_of(cells, 4000)
    levels = np.rint(cells[:, :1].astype(np.int64) - 32 + rng.normal(size=(4000, 1))).astype(np.int32)
    alone = entropy.encode_levels(levels, np.full_like(near, -1))
    assert len(entropy.encode_levels(levels, near)) < 0.7 * len(alone)


def test_neighbours_are_the_nearest_of_the_window():
    cells, block = np.random.default_rng(0).integers(0, 1000, (500, 3)), 200
    near = entropy.neighbours_of(cells, block)
    for i in range(500):
        first = max(i // block * block, i - entropy.WINDOW)
        distances = ((cells[first:i] - cells[i]) ** 2).sum(axis=1)
        found = near[i][near[i] >= 0]
        assert len(found) == min(entropy.NEIGHBOURS, i - first)
        assert np.array_equal(((cells[found] - cells[i]) ** 2).sum(axis=1), np.sort(distances)[: len(found)])


def test_the_numbers_of_the_format():
    """Tables come from exponentials, whose last bits differ between machines; the rounded numbers must not."""
    digest = hashlib.sha256()
    for table in (entropy._SQUASH, entropy._STRETCH, entropy._RATES):
        digest.update(table.astype("<i4").tobytes())
    exact = 4096 / (1 + np.exp(-np.arange(-2047, 2048) / 256))
    assert np.abs(exact % 1 - 0.5).min() > 1e-6
    assert digest.hexdigest()[:16] == "15160911aa9b93af"
    rng = np.random.default_rng(0)  # of whole numbers, which are the same on every machine
    levels = (rng.integers(-1, 2, (6000, 3)) << rng.integers(0, 24, (6000, 3))).astype(np.int32)
    levels[:, 2], levels[::500], levels[1000:2000, 0] = 0, LARGEST, -1
    near = entropy.neighbours_of(rng.integers(0, 30, (6000, 3)), 256)  # with ties
    streams = entropy.encode_levels(levels, near), entropy.encode_gaps(cells_of(6000, 10, 256, 0), 256, 10)
    digests = [hashlib.sha256(stream.tobytes()).hexdigest()[:16] for stream in streams]
    assert digests == ["2e5e2f9f19a55194", "0decf469d7703824"]


@given(st.binary(min_size=100, max_size=100), st.integers(1, 40))
def test_other_streams_are_refused_or_within_the_limits(content, n):
    for end in range(101):  # of random bytes, some starts end with the last number
        stream = np.frombuffer(content[:end], np.uint8)
        with suppress(ValueError):
            assert np.abs(entropy.decode_levels(stream, 3, entropy.predecessors(n))).max() <= LARGEST
        with suppress(ValueError):
            codes = entropy.decode_gaps(stream, n, 16, 5)
            assert codes.max() < 1 << 15
            assert (codes[1:] >= codes[:-1])[np.arange(1, n) % 16 != 0].all()


def test_a_stream_of_more_or_fewer_numbers_is_refused():
    levels = np.random.default_rng(0).integers(-1000, 1000, (100, 2)).astype(np.int32)
    stream = entropy.encode_levels(levels, entropy.predecessors(100))
    for other, count in ((np.append(stream, np.uint8(0)), 100), (stream, 80), (stream, 120)):
        with pytest.raises(ValueError, match="does not end with its last number"):
            entropy.decode_levels(other, 2, entropy.predecessors(count))
