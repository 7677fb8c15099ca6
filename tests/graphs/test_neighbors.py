"""Neighbour search against brute force, and where it must not break: clones, offsets, floaters, too few points."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.graphs import knn, radius_neighbors


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


@pytest.mark.parametrize("n", [0, 1])
def test_radius_neighbors_of_almost_nothing(n: int) -> None:
    found = radius_neighbors(torch.zeros(n, 3), 1.0, 4)
    assert found.indices.shape == (n, 4)
    assert found.distances.isinf().all()


@pytest.mark.gpu
def test_knn_returns_to_the_gpu() -> None:
    points = torch.rand(50, 3)
    on_gpu = knn(points.cuda(), 4)
    assert on_gpu.indices.is_cuda
    assert on_gpu.distances.is_cuda
    assert torch.equal(on_gpu.indices.cpu(), knn(points, 4).indices)
