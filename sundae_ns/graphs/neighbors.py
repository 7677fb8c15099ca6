"""Exact neighbour search: the one seam behind which another engine can be put."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError


class Neighbors(NamedTuple):
    """Neighbours of every point, nearest first; a point is never its own neighbour."""

    indices: Tensor
    """Neighbour indices, int64 ``[N, K]``; the point's own index where a neighbour is missing."""
    distances: Tensor
    """Euclidean distances in scene units ``[N, K]``, dtype of the points; ``inf`` where a neighbour is missing."""


def knn(points: Tensor, k: int) -> Neighbors:
    """Exact ``k`` nearest neighbours of every point, without the point itself.

    Coincident points are neighbours of each other at distance 0. Which of several equally distant points is taken as
    the last neighbour is left to the search. The search runs on the CPU; the result returns to the points' device.

    Args:
        points: positions in scene units, any floating dtype and device ``[N, 3]``.
        k: number of neighbours, at least 1 and less than N.

    Returns:
        Indices and ascending distances ``[N, k]``.

    Raises:
        ConfigError: ``k`` is less than 1.
        DataError: there are not more than ``k`` points, or points have a wrong shape or are not finite.
    """
    if k < 1:
        raise ConfigError(f"a neighbour search for {k} neighbours finds nothing: ask for at least 1")
    coordinates = _coordinates(points)
    n = len(coordinates)
    if n <= k:
        raise DataError(
            f"{n} primitives cannot have {k} neighbours each: use at most {max(n - 1, 0)} neighbours, "
            "or a field with more primitives"
        )
    distances, indices = cKDTree(coordinates).query(coordinates, k=k + 1, workers=-1)
    return _without_self(points, indices, distances)


def radius_neighbors(points: Tensor, radius: float, max_neighbors: int) -> Neighbors:
    """The nearest neighbours closer than a radius, padded to a fixed width.

    Args:
        points: positions in scene units, any floating dtype and device ``[N, 3]``; N may be 0.
        radius: neighbours are strictly closer than this, scene units.
        max_neighbors: width of the result; of more neighbours than this, the nearest are kept.

    Returns:
        Indices and ascending distances ``[N, max_neighbors]``; own index and ``inf`` where a neighbour is missing.

    Raises:
        ConfigError: ``radius`` is not positive or ``max_neighbors`` is less than 1.
        DataError: points have a wrong shape or are not finite.
    """
    if not radius > 0:
        raise ConfigError(f"a search radius of {radius} finds nothing: use a positive one")
    if max_neighbors < 1:
        raise ConfigError(f"room for {max_neighbors} neighbours holds nothing: use at least 1")
    coordinates = _coordinates(points)
    n = len(coordinates)
    if n == 0:
        shape = (0, max_neighbors)
        return Neighbors(torch.empty(shape, dtype=torch.int64, device=points.device), points.new_empty(shape))
    distances, indices = cKDTree(coordinates).query(
        coordinates, k=max_neighbors + 1, distance_upper_bound=radius, workers=-1
    )
    indices = np.where(np.isinf(distances), np.arange(n)[:, None], indices)
    return _without_self(points, indices, distances)


def _coordinates(points: Tensor) -> np.ndarray:
    """Points as float64 on the CPU ``[N, 3]``.

    The tree subtracts coordinates directly, so float64 alone keeps the digits of a scene far from the origin. Moving
    the centroid to the origin would not help and could hurt: one floater at 1e20 would drag it there and erase the
    scene.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"positions have shape {list(points.shape)}: pass [N, 3]")
    coordinates = points.detach().to(device="cpu", dtype=torch.float64).numpy()
    bad = int((~np.isfinite(coordinates)).any(axis=1).sum())
    if bad:
        raise DataError(f"{bad} of {len(coordinates)} positions are NaN or infinite: drop them before building a graph")
    return coordinates


def _without_self(points: Tensor, indices: np.ndarray, distances: np.ndarray) -> Neighbors:
    """Remove one column per row: the own index with a finite distance or, where it is absent, the last one.

    The own index need not come first among coincident points, and is absent where a row is filled with them: every
    entry of such a row is at distance 0, so any one can go.
    """
    n, width = indices.shape
    is_self = (indices == np.arange(n)[:, None]) & np.isfinite(distances)
    is_self[:, -1] |= ~is_self.any(axis=1)
    others = ~is_self
    kept_indices = torch.from_numpy(indices[others].reshape(n, width - 1).astype(np.int64, copy=False))
    kept_distances = torch.from_numpy(distances[others].reshape(n, width - 1))
    return Neighbors(kept_indices.to(points.device), kept_distances.to(points.dtype).to(points.device))
