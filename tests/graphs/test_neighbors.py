"""Neighbour search against brute force: clones, offsets, floaters, too few points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sundae_ns.errors import BackendError, ConfigError, DataError
from sundae_ns.graphs import host_search, knn, neighbors
from sundae_ns.graphs.traversal import MAX_NEIGHBORS


def brute_force(points: torch.Tensor) -> torch.Tensor:
    distances = (points.double()[:, None] - points.double()[None]).norm(dim=-1)
    return distances.fill_diagonal_(torch.inf).sort(dim=1).values


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_knn_matches_brute_force(dtype: torch.dtype) -> None:
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=dtype)
    found = knn(points, 7)
    assert found.indices.shape == found.distances.shape == (200, 7)
    assert found.indices.dtype == torch.int64
    assert found.distances.dtype == dtype
    torch.testing.assert_close(found.distances, brute_force(points)[:, :7].to(dtype))
    torch.testing.assert_close((points[:, None] - points[found.indices]).norm(dim=-1), found.distances)


@given(st.lists(st.integers(0, 2), min_size=2, max_size=40), st.integers(1, 10))
def test_knn_never_returns_self_or_duplicates(cells: list[int], k: int) -> None:
    points = torch.tensor(cells, dtype=torch.float32)[:, None].expand(-1, 3)
    k = min(k, len(cells) - 1)
    found = knn(points, k)
    assert not (found.indices == torch.arange(len(cells))[:, None]).any()
    assert all(len(set(row)) == k for row in found.indices.tolist())
    torch.testing.assert_close(found.distances, brute_force(points)[:, :k].float())


def test_knn_survives_thousands_of_coincident_points() -> None:
    points = torch.cat([torch.zeros(3000, 3), torch.ones(5, 3)])
    found = knn(points, 8)
    assert not (found.indices == torch.arange(3005)[:, None]).any()
    assert (found.distances[:3000] == 0).all()
    assert (found.distances[3000:, :4] == 0).all()
    assert (found.distances[3000:, 4:] > 1.7).all()


def test_one_far_floater_costs_the_others_no_precision() -> None:
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    alone = knn(points, 3)
    with_floater = knn(torch.cat([points, torch.full((1, 3), 1e20)]), 3)
    assert torch.equal(with_floater.indices[:50], alone.indices)
    assert torch.equal(with_floater.distances[:50], alone.distances)


@pytest.mark.parametrize(("n", "k"), [(0, 1), (1, 1), (5, 5), (5, 9)])
def test_too_few_points_are_refused_with_the_count_that_works(n: int, k: int) -> None:
    with pytest.raises(DataError, match=rf"{n} primitives cannot have {k} neighbours.*at most {max(n - 1, 0)}"):
        knn(torch.zeros(n, 3), k)


def test_wrong_input_is_refused() -> None:
    with pytest.raises(ConfigError, match="at least 1"):
        knn(torch.zeros(5, 3), 0)
    with pytest.raises(DataError, match=r"\[5, 2\]"):
        knn(torch.zeros(5, 2), 1)
    with pytest.raises(DataError, match="2 of 5 positions are NaN"):
        knn(torch.tensor([0.0, torch.nan, 1.0, torch.inf, 2.0])[:, None].expand(-1, 3), 1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("n", "k"), [(700, 16), (130, 3), (40, 39), (2, 1)])
def test_neighbours_are_ordered_by_distance_and_then_by_index(
    cloud: Callable, truth: Callable, dtype: torch.dtype, n: int, k: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = cloud(n).to(dtype)
    expected, expected_distances = truth(points, k)
    for elements in (host_search.CHUNK_ELEMENTS, 100):
        monkeypatch.setattr(host_search, "CHUNK_ELEMENTS", elements)
        found = knn(points, k)
        assert torch.equal(found.indices, expected)
        assert torch.equal(found.distances, expected_distances)


@pytest.mark.parametrize("copies", [1, 3])
@pytest.mark.parametrize("alike", [2, 50])
def test_two_positions_of_one_hash_stay_apart(
    monkeypatch: pytest.MonkeyPatch, truth: Callable, copies: int, alike: int
) -> None:
    points = torch.randn(50, 3).repeat(copies, 1)
    hashed = host_search._hash
    shared = np.sort(hashed(points.double().numpy().view(np.uint64)))[::copies][:alike]
    # These look like clones until they are compared, also without a copy.
    monkeypatch.setattr(host_search, "_hash", lambda bits: np.where(np.isin(h := hashed(bits), shared), 0, h))
    assert torch.equal(knn(points, 6).indices, truth(points, 6)[0])


def test_positions_whose_squares_overflow_are_refused() -> None:
    points = torch.zeros(5, 3, dtype=torch.float64)
    points[0, 0] = 1e200
    with pytest.raises(DataError, match="1e.150"):
        knn(points, 2)


def test_without_a_kernel_the_cpu_searches_and_logs_one_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> None:
        raise BackendError("no compiler on board")

    monkeypatch.setattr(neighbors, "Kernel", broken)
    neighbors._kernel.cache_clear()
    device = torch.device("cuda", 0)
    with caplog.at_level("WARNING"):
        assert [neighbors._kernel(device, torch.float32, 16) for _ in range(3)] == [None] * 3
    assert [record.getMessage().count("\n") for record in caplog.records] == [0]
    assert "search runs on the CPU" in caplog.text
    assert "no compiler on board" in caplog.text
    neighbors._kernel.cache_clear()


def test_more_neighbours_than_the_kernel_supports_are_searched_on_the_cpu(caplog: pytest.LogCaptureFixture) -> None:
    neighbors._kernel.cache_clear()
    with caplog.at_level("WARNING"):
        assert neighbors._kernel(torch.device("cuda", 0), torch.float32, MAX_NEIGHBORS + 1) is None
    assert f"at most {MAX_NEIGHBORS} neighbours, not {MAX_NEIGHBORS + 1}" in caplog.text
    neighbors._kernel.cache_clear()
