"""Search on the CPU with ties: points so far away that float64 cannot separate the others."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from sundae_ns.graphs import host_search, knn

FAR = (1e18, 1e20, 1e25, 1e30, 1e38)


def with_floaters(cluster: Tensor) -> Tensor:
    """A cluster and one point at about each distance of :data:`FAR`, shuffled, float64 ``[N, 3]``."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(len(FAR), 3, generator=generator, dtype=torch.float64)
    points = torch.cat([cluster, directions * torch.tensor(FAR, dtype=torch.float64)[:, None]])
    return points[torch.randperm(len(points), generator=generator)]


def with_clones(n: int) -> Tensor:
    """Normal points, every fourth of them four times, float64 ``[N, 3]``."""
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return torch.cat([points, points[: n // 4].repeat(3, 1)])


def lattice(n: int) -> Tensor:
    """Points on a cubic lattice, so that many distances are equal, float64 ``[N, 3]``."""
    side = round(n ** (1 / 3)) + 1
    return torch.cartesian_prod(*[torch.arange(side, dtype=torch.float64)] * 3)[:n]


CLUSTERS: dict[str, Callable[[int], Tensor]] = {
    "clones": with_clones,
    "lattice": lattice,
    "pile": lambda n: torch.zeros(n, 3, dtype=torch.float64),
}


@pytest.mark.parametrize("width", [1, 2, 9, 40, 10_000])
@pytest.mark.parametrize("cluster", CLUSTERS.values(), ids=CLUSTERS)
def test_nearest_of_all_is_ordered_by_squared_distance_and_index(cluster: Callable[[int], Tensor], width: int) -> None:
    coordinates = with_floaters(cluster(100)).numpy()
    positions = host_search._distinct(coordinates)
    rows = np.arange(len(positions.coordinates))
    _, points, lengths = map(np.concatenate, zip(*host_search._nearest_of_all(positions, rows, width), strict=True))
    assert points.shape == lengths.shape == (len(rows), min(width, len(coordinates)))
    for row in rows:
        x, y, z = (coordinates - positions.coordinates[row]).T
        squared = x * x + y * y + z * z
        expected = np.lexsort((np.arange(len(coordinates)), squared))[:width]
        assert np.array_equal(points[row], expected)
        assert np.array_equal(lengths[row], np.sqrt(squared[expected]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_floaters_match_all_pairs_and_compare_with_all_points_at_once(
    monkeypatch: pytest.MonkeyPatch, truth: Callable, dtype: torch.dtype
) -> None:
    points, k = with_floaters(with_clones(400)).to(dtype), 6
    asked: list[int] = []
    compared_with_all: list[int] = []
    query, nearest_of_all = host_search._query, host_search._nearest_of_all
    monkeypatch.setattr(host_search, "_query", lambda *args: (asked.append(args[2]), query(*args))[1])
    monkeypatch.setattr(
        host_search, "_nearest_of_all", lambda *args: (compared_with_all.append(len(args[1])), nearest_of_all(*args))[1]
    )
    found = knn(points, k)
    expected, distances = truth(points, k)
    assert torch.equal(found.indices, expected)
    assert torch.equal(found.distances, distances)
    assert set(asked) == {k + 2, host_search.ASKED_AGAIN * (k + 2)}
    assert sum(compared_with_all) == len(FAR)


@pytest.mark.parametrize("cluster", CLUSTERS.values(), ids=CLUSTERS)
def test_memory_grows_with_points_and_not_with_their_square(
    monkeypatch: pytest.MonkeyPatch, cluster: Callable[[int], Tensor]
) -> None:
    # tracemalloc sees numpy's arrays, not scipy's tree. One thread, so that the sum does not depend on timing.
    monkeypatch.setattr(host_search, "cores", lambda: 1)

    def peak(n: int) -> int:
        coordinates = with_floaters(cluster(n)).numpy()
        tracemalloc.start()
        try:
            host_search.nearest(coordinates, 16, np.float32)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    assert peak(16_000) < 5 * peak(4_000)
