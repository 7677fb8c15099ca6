"""Neighbour search against brute force, and where it must not break: clones, offsets, floaters, too few points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sundae_ns.errors import BackendError, ConfigError, DataError
from sundae_ns.graphs import host_search, knn, neighbors, radius_neighbors
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


@settings(max_examples=40, deadline=None)
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


def test_one_far_floater_does_not_cost_the_others_their_digits() -> None:
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    alone = knn(points, 3)
    with_floater = knn(torch.cat([points, torch.full((1, 3), 1e20)]), 3)
    assert torch.equal(with_floater.indices[:50], alone.indices)
    assert torch.equal(with_floater.distances[:50], alone.distances)


@pytest.mark.parametrize(("n", "k"), [(0, 1), (1, 1), (5, 5), (5, 9)])
def test_too_few_points_name_the_count_and_the_mend(n: int, k: int) -> None:
    with pytest.raises(DataError, match=rf"{n} primitives cannot have {k} neighbours.*at most {max(n - 1, 0)}"):
        knn(torch.zeros(n, 3), k)


def test_wrong_input_is_refused() -> None:
    with pytest.raises(ConfigError, match="at least 1"):
        knn(torch.zeros(5, 3), 0)
    with pytest.raises(DataError, match=r"\[5, 2\]"):
        knn(torch.zeros(5, 2), 1)
    with pytest.raises(DataError, match="2 of 5 positions are NaN"):
        knn(torch.tensor([0.0, torch.nan, 1.0, torch.inf, 2.0])[:, None].expand(-1, 3), 1)
    with pytest.raises(ConfigError, match="radius"):
        radius_neighbors(torch.zeros(5, 3), 0.0, 3)
    with pytest.raises(ConfigError, match="at least 1"):
        radius_neighbors(torch.zeros(5, 3), 1.0, 0)


def test_radius_neighbors_match_brute_force_and_are_padded() -> None:
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = radius_neighbors(points, 0.25, 6)
    expected = brute_force(points)[:, :6]
    expected[expected >= 0.25] = torch.inf
    torch.testing.assert_close(found.distances, expected)
    missing = found.distances.isinf()
    own = torch.arange(100)[:, None].expand(-1, 6)
    assert 0 < missing.sum() < missing.numel()
    assert torch.equal(found.indices == own, missing)


@pytest.mark.parametrize("radius", [1e-150, 1e-170, 5e-324])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_clones_lie_within_a_radius_whose_square_underflows(radius: float, dtype: torch.dtype) -> None:
    points = torch.cat([torch.zeros(4, 3, dtype=dtype), torch.full((1, 3), 1e-30, dtype=dtype)])
    found = radius_neighbors(points, radius, 2)
    assert found.indices.tolist() == [[1, 2], [0, 2], [0, 1], [0, 1], [4, 4]]
    assert (found.distances[:4] == 0).all()
    assert found.distances[4].isinf().all()


@pytest.mark.parametrize("n", [0, 1])
def test_radius_neighbors_of_almost_nothing(n: int) -> None:
    found = radius_neighbors(torch.zeros(n, 3), 1.0, 4)
    assert found.indices.shape == (n, 4)
    assert found.distances.isinf().all()


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


def test_radius_is_exclusive_and_ties_at_the_cap_go_to_the_lower_index(cloud: Callable, truth: Callable) -> None:
    points = cloud(300).float()
    everyone, distances = truth(points, 299)
    radius = max(float(distances[:, 5].median()), 1e-6)
    found = radius_neighbors(points, radius, 8)
    _, exact = truth(points.double(), 8)
    inside = exact < radius
    assert torch.equal(found.distances, distances[:, :8].masked_fill(~inside, torch.inf))
    assert torch.equal(found.indices, torch.where(inside, everyone[:, :8], torch.arange(300)[:, None]))


@pytest.mark.parametrize("copies", [1, 3])
@pytest.mark.parametrize("alike", [2, 50])
def test_two_positions_of_one_hash_are_not_mixed_up(
    monkeypatch: pytest.MonkeyPatch, truth: Callable, copies: int, alike: int
) -> None:
    points = torch.randn(50, 3).repeat(copies, 1)
    hashed = host_search._hash
    shared = np.sort(hashed(points.double().numpy().view(np.uint64)))[::copies][:alike]
    # Without a copy, too, these look like clones until they are compared.
    monkeypatch.setattr(host_search, "_hash", lambda bits: np.where(np.isin(h := hashed(bits), shared), 0, h))
    assert torch.equal(knn(points, 6).indices, truth(points, 6)[0])


def test_positions_too_far_out_for_their_squares_are_refused() -> None:
    points = torch.zeros(5, 3, dtype=torch.float64)
    points[0, 0] = 1e200
    with pytest.raises(DataError, match="1e.150"):
        knn(points, 2)


def test_without_a_kernel_the_cpu_searches_and_one_line_says_so(
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
    assert "searched on the CPU" in caplog.text
    assert "no compiler on board" in caplog.text
    neighbors._kernel.cache_clear()


def test_more_neighbours_than_the_kernel_takes_go_to_the_cpu(caplog: pytest.LogCaptureFixture) -> None:
    neighbors._kernel.cache_clear()
    with caplog.at_level("WARNING"):
        assert neighbors._kernel(torch.device("cuda", 0), torch.float32, MAX_NEIGHBORS + 1) is None
    assert f"{MAX_NEIGHBORS + 1} neighbours" in caplog.text
    neighbors._kernel.cache_clear()
