"""Exact neighbour search: one interface, scipy's k-d tree on the CPU and our own kernel on a GPU behind it.

Both order neighbours by squared distance in float64 and then by index, so that the same points have the same neighbours
on every device. Coordinates are subtracted in float64, which is exact for float32 positions of like size: a scene far
from the origin loses no digit that its positions still have.
"""

from __future__ import annotations

import functools
import logging
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sundae_ns.errors import BackendError, ConfigError, DataError
from sundae_ns.gpu.nvrtc import Kernel
from sundae_ns.graphs import host_search, traversal
from sundae_ns.graphs.tree import build_tree

MOST_EXTENT = 1e150
"""Coordinates up to this have squared distances that float64 can hold."""

_log = logging.getLogger(__name__)


class Neighbors(NamedTuple):
    """Neighbours of every point, nearest first; a point is never its own neighbour."""

    indices: Tensor
    """Neighbour indices, int64 ``[N, K]``; the point's own index where a neighbour is missing."""
    distances: Tensor
    """Euclidean distances in scene units ``[N, K]``, dtype of the points; ``inf`` where a neighbour is missing."""


def knn(points: Tensor, k: int) -> Neighbors:
    """Exact ``k`` nearest neighbours of every point, without the point itself.

    Coincident points are neighbours of each other at distance 0. Of equally distant points the lower index comes first,
    also where only some of them find room. The search runs on the points' device; where the kernel for a GPU cannot be
    compiled, and beyond :data:`sundae_ns.graphs.traversal.MAX_NEIGHBORS` neighbours, it runs on the CPU.

    Args:
        points: positions in scene units, any floating dtype and device ``[N, 3]``.
        k: number of neighbours, at least 1 and less than N.

    Returns:
        Indices and ascending distances ``[N, k]``, on the points' device.

    Raises:
        ConfigError: ``k`` is less than 1.
        DataError: there are not more than ``k`` points, or points have a wrong shape, are not finite, or lie farther
            out than 1e150.
    """
    if k < 1:
        raise ConfigError(f"a neighbour search for {k} neighbours finds nothing: ask for at least 1")
    _check(points)
    n = len(points)
    if n <= k:
        raise DataError(
            f"{n} primitives cannot have {k} neighbours each: use at most {max(n - 1, 0)} neighbours, "
            "or a field with more primitives"
        )
    return _search(points, k, torch.inf)


def radius_neighbors(points: Tensor, radius: float, max_neighbors: int) -> Neighbors:
    """The nearest neighbours closer than a radius, padded to a fixed width.

    Args:
        points: positions in scene units, any floating dtype and device ``[N, 3]``; N may be 0.
        radius: neighbours are strictly closer than this, scene units.
        max_neighbors: width of the result; of more neighbours than this, the nearest are kept, as by :func:`knn`.

    Returns:
        Indices and ascending distances ``[N, max_neighbors]``; own index and ``inf`` where a neighbour is missing.

    Raises:
        ConfigError: ``radius`` is not positive or ``max_neighbors`` is less than 1.
        DataError: points have a wrong shape, are not finite, or lie farther out than 1e150.
    """
    if not radius > 0:
        raise ConfigError(f"a search radius of {radius} finds nothing: use a positive one")
    if max_neighbors < 1:
        raise ConfigError(f"room for {max_neighbors} neighbours holds nothing: use at least 1")
    _check(points)
    if len(points) == 0:
        shape = (0, max_neighbors)
        return Neighbors(torch.empty(shape, dtype=torch.int64, device=points.device), points.new_empty(shape))
    # The square of a radius below 1.5e-162 is 0, and nothing is closer than that; clones are closer than the next number.
    return _search(points, max_neighbors, max(radius * radius, math.ulp(0.0)))


def _search(points: Tensor, k: int, limit: float) -> Neighbors:
    """The search itself, on the device that can do it; ``limit`` bounds squared distances."""
    kernel = _kernel(points.device, _tree_dtype(points), k) if points.is_cuda else None
    if kernel is None:
        coordinates = points.detach().to(device="cpu", dtype=torch.float64).numpy()
        dtype = np.float64 if points.dtype == torch.float64 else np.float32
        indices, distances = host_search.nearest(np.ascontiguousarray(coordinates), k, limit, dtype)
        found = torch.from_numpy(indices), torch.from_numpy(distances)
        return Neighbors(found[0].to(points.device), found[1].to(points.device, points.dtype))
    tree = build_tree(points.detach().to(_tree_dtype(points)))
    on_device, lengths = traversal.search_tree(tree, k, limit, kernel)
    return Neighbors(on_device, lengths.to(points.dtype))


def _tree_dtype(points: Tensor) -> torch.dtype:
    """The dtype that holds the points exactly and that the kernel knows."""
    return torch.float64 if points.dtype == torch.float64 else torch.float32


@functools.cache
def _kernel(device: torch.device, dtype: torch.dtype, k: int) -> Kernel | None:
    """The kernel for this device; None, and one logged line, where there is none. Cached, for compiling takes 0.1 s."""
    if k > traversal.MAX_NEIGHBORS:
        reason = f"{k} neighbours are more than the {traversal.MAX_NEIGHBORS} that it has room for"
    else:
        options = (*traversal.OPTIONS, *traversal.definitions(dtype, k))
        try:
            return Kernel(traversal.SOURCE, traversal.KERNEL, device, options, traversal.BLOCK)
        except BackendError as error:
            reason = str(error)
    _log.warning("neighbours are searched on the CPU, not with the kernel for %s: %s", device, reason)
    return None


def _check(points: Tensor) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"positions have shape {list(points.shape)}: pass [N, 3]")
    bad = int((~torch.isfinite(points)).any(dim=1).sum())
    if bad:
        raise DataError(f"{bad} of {len(points)} positions are NaN or infinite: drop them before building a graph")
    if points.dtype == torch.float64 and len(points) and float(points.detach().abs().max()) > MOST_EXTENT:
        raise DataError(f"positions lie farther out than {MOST_EXTENT:g}: their squared distances overflow, scale them")
