"""Exact neighbour search: one interface to scipy's k-d tree on the CPU and to our own kernel on a GPU.

Both order neighbours by squared distance in float64 and then by index, so the same points have the same neighbours on
every device. Coordinates are subtracted in float64. For float32 positions of similar size this is exact, so a scene far
from the origin loses no further digits.
"""

from __future__ import annotations

import functools
import logging
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sundae_ns.errors import BackendError, ConfigError, DataError
from sundae_ns.gpu.nvrtc import Kernel
from sundae_ns.graphs import host_search, traversal
from sundae_ns.graphs.tree import build_tree

MOST_EXTENT = 1e150
"""Largest coordinate whose squared distances float64 can hold."""

_log = logging.getLogger(__name__)


class Neighbors(NamedTuple):
    """Neighbours of every point, nearest first; a point is never its own neighbour."""

    indices: Tensor
    """Neighbour indices, int64 ``[N, K]``."""
    distances: Tensor
    """Euclidean distances in scene units ``[N, K]``, dtype of the points; ``inf`` if that dtype overflows."""


def knn(points: Tensor, k: int) -> Neighbors:
    """Exact ``k`` nearest neighbours of every point, without the point itself.

    Coincident points are neighbours of each other at distance 0. Among equally distant points the lower index comes
    first, also at the end of the list. The search runs on the points' device. It runs on the CPU if the GPU kernel
    cannot be compiled, or for more than :data:`sundae_ns.graphs.traversal.MAX_NEIGHBORS` neighbours.

    Args:
        points: positions in scene units, any floating dtype and device ``[N, 3]``.
        k: number of neighbours, at least 1 and less than N.

    Returns:
        Indices and ascending distances ``[N, k]``, on the points' device.

    Raises:
        ConfigError: ``k`` is less than 1.
        DataError: at most ``k`` points, or points that have a wrong shape, are not finite, or exceed 1e150.
    """
    if k < 1:
        raise ConfigError(f"cannot search for {k} neighbours: use at least 1")
    _check(points)
    n = len(points)
    if n <= k:
        raise DataError(
            f"{n} primitives cannot have {k} neighbours each: use at most {max(n - 1, 0)} neighbours, "
            "or a field with more primitives"
        )
    # Supported by the kernel, and exact for the points.
    dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
    kernel = _kernel(points.device, dtype, k) if points.is_cuda else None
    if kernel is None:
        coordinates = points.detach().to(device="cpu", dtype=torch.float64).numpy()
        found = host_search.nearest(np.ascontiguousarray(coordinates), k, str(dtype).removeprefix("torch."))
        indices, distances = (torch.from_numpy(values).to(points.device) for values in found)
    else:
        indices, distances = traversal.search_tree(build_tree(points.detach().to(dtype)), k, kernel)
    return Neighbors(indices, distances.to(points.dtype))


@functools.cache
def _kernel(device: torch.device, dtype: torch.dtype, k: int) -> Kernel | None:
    """The kernel for this device, or None and one logged line if it cannot run. Cached: compiling takes 0.1 s."""
    if k > traversal.MAX_NEIGHBORS:
        reason = f"it supports at most {traversal.MAX_NEIGHBORS} neighbours, not {k}"
    else:
        options = (*traversal.OPTIONS, *traversal.definitions(dtype, k))
        try:
            return Kernel(traversal.FILE, traversal.KERNEL, device, options, traversal.BLOCK)
        except BackendError as error:
            reason = str(error)
    _log.warning("neighbour search runs on the CPU, not on %s: %s", device, reason)
    return None


def _check(points: Tensor) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"positions have shape {list(points.shape)}: pass [N, 3]")
    bad = int((~torch.isfinite(points)).any(dim=1).sum())
    if bad:
        raise DataError(f"{bad} of {len(points)} positions are NaN or infinite: drop them before building a graph")
    if points.dtype == torch.float64 and len(points) and float(points.detach().abs().max()) > MOST_EXTENT:
        raise DataError(f"positions exceed {MOST_EXTENT:g}: their squared distances overflow, scale the scene")
