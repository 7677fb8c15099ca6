"""Exact neighbour search: scipy's k-d tree on the CPU, and on a GPU ``csrc/neighbors.cu`` over a tree of boxes.

Coordinates are subtracted in float64. For float32 positions of similar size this is exact, so a scene far from the
origin loses no further digits.

The tree of boxes is balanced and built with torch on the points' device. Points are split at the median of the widest
axis of their box, level by level, until at most 16 are left. Medians adapt to any spread: clusters of 1e-5 beside a
background of 1e3, or a floater at 1e20, cost no resolution. A uniform grid or a Morton code would lose it.
"""

from __future__ import annotations

import functools
import logging
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from sundae_ns.core.errors import BackendError, ConfigError, DataError
from sundae_ns.cuda.kernels import Kernel, Launch

MOST_EXTENT = 1e150  # largest coordinate whose squared distances float64 can hold
MAX_NEIGHBORS = 128  # most neighbours that the kernel supports; lists of up to about 32 stay in registers
LEAF = 8  # fewest points of a leaf if the tree has several; leaves hold fewer than twice as many
FILE, KERNEL = "neighbors.cu", "nearest"  # source file of the kernel, and its name
CHUNK = 2**16  # points searched at a time on the CPU; the arrays of each take about 50 MiB

_log = logging.getLogger(__name__)


class Neighbors(NamedTuple):
    """Neighbours of every point, nearest first; a point is never its own neighbour."""

    indices: Tensor  # Neighbour indices, int64 [N, K]
    distances: Tensor  # Euclidean distances in scene units [N, K], dtype of the points; inf if that dtype overflows


def knn(points: Tensor, k: int) -> Neighbors:
    """Exact ``k`` nearest neighbours of every point but itself: indices and ascending distances ``[N, k]``.

    Coincident points are neighbours of each other at distance 0, those of lower index first. Other points at equal
    distances may come in any order. ``points`` ``[N, 3]`` have any floating dtype; the search runs on their device. It
    runs on the CPU if the GPU kernel cannot be compiled, or for more than :data:`MAX_NEIGHBORS` neighbours.
    ``ConfigError`` for no neighbours; ``DataError`` for at most ``k`` points, a wrong shape, and points that are not
    finite or exceed 1e150.
    """
    if k < 1:
        raise ConfigError(f"cannot search for {k} neighbours: use at least 1")
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"positions have shape {list(points.shape)}: pass [N, 3]")
    n = len(points)
    if bad := int((~torch.isfinite(points)).any(dim=1).sum()):
        raise DataError(f"{bad} of {n} positions are NaN or infinite: drop them before building a graph")
    if points.dtype == torch.float64 and n and float(points.detach().abs().max()) > MOST_EXTENT:
        raise DataError(f"positions exceed {MOST_EXTENT:g}: their squared distances overflow, scale the scene")
    if n <= k:
        raise DataError(
            f"{n} Gaussians cannot have {k} neighbours each: use at most {max(n - 1, 0)} neighbours, "
            "or a field with more Gaussians"
        )
    # Supported by the kernel, and exact for the points.
    dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
    kernel = _kernel(points.device, dtype, k) if points.is_cuda else None
    if kernel is None:
        coordinates = np.ascontiguousarray(points.detach().to(device="cpu", dtype=torch.float64).numpy())
        neighbors = _search_host(coordinates, k, str(dtype).removeprefix("torch."))
        indices, distances = (torch.from_numpy(values).to(points.device) for values in neighbors)
    else:
        indices, distances = search_tree(build_tree(points.detach().to(dtype)), k, kernel)
    return Neighbors(indices, distances.to(points.dtype))


def _search_host(
    coordinates: NDArray[np.float64], k: int, dtype: DTypeLike
) -> tuple[NDArray[np.int64], NDArray[np.floating]]:
    """Indices and ascending distances ``[N, k]`` of the neighbours of points ``[N, 3]``."""
    from scipy.spatial import cKDTree  # takes half a second, also in commands that search nothing

    n = len(coordinates)
    order = np.lexsort(coordinates.T)  # clones are adjacent, the lowest index first
    apart = (coordinates[order[1:]] != coordinates[order[:-1]]).any(axis=1)
    starts = np.flatnonzero(np.append(True, apart))
    counts = np.diff(np.append(starts, n))
    # Fitting boxes to their points takes a quarter of the time to build, and saves nothing in a balanced tree.
    tree = cKDTree(coordinates[order[starts]], compact_nodes=False)
    indices, distances = np.empty((n, k), np.int64), np.empty((n, k), dtype)
    slots = np.arange(k + 1)
    nearest = np.arange(1, min(k + 1, len(starts)) + 1)
    for rows in np.array_split(order, -(-n // CHUNK)):
        lengths, positions = tree.query(coordinates[rows], k=nearest, workers=-1)
        points = order[starts[positions]]
        if len(starts) < n:
            # Slot s of a row is the first position whose count ends above s. A lift keeps rows apart in one search.
            lift = (k + 2) * np.arange(len(rows))[:, None]
            ends = counts[positions].cumsum(axis=1)
            used = np.searchsorted((ends.clip(max=k + 1) + lift).ravel(), slots + lift, side="right")
            positions, ends, lengths = positions.ravel()[used], ends.ravel()[used], lengths.ravel()[used]
            points = order[starts[positions] + slots - ends + counts[positions]]
        # Without the point itself. Clones of lower index may fill the row; then the last one goes.
        others = points != rows[:, None]
        others[:, -1] &= ~others.all(axis=1)
        indices[rows], distances[rows] = points[others].reshape(-1, k), lengths[others].reshape(-1, k)
    return indices, distances


@functools.cache
def _kernel(device: torch.device, dtype: torch.dtype, k: int) -> Kernel | None:
    """The kernel for this device, or None and one logged line if it cannot run. Cached: compiling takes 0.1 s."""
    try:
        if k > MAX_NEIGHBORS:
            raise BackendError(f"it supports at most {MAX_NEIGHBORS} neighbours, not {k}")
        return load_kernel(device, dtype, k)
    except BackendError as error:
        _log.warning("neighbour search runs on the CPU, not on %s: %s", device, error)
        return None


def kernel_options(dtype: torch.dtype, k: int) -> tuple[str, ...]:
    """Compiler options for the type of the coordinates and the number of neighbours."""
    # Fused multiply-adds would round distances to boxes and to points differently.
    return ("--fmad=false", f"-DREAL={'double' if dtype == torch.float64 else 'float'}", f"-DK={k}")


def load_kernel(device: torch.device, dtype: torch.dtype, k: int) -> Kernel:
    """The kernel for a CUDA device; raises ``BackendError`` if it cannot be compiled or loaded."""
    return Kernel(FILE, KERNEL, device, kernel_options(dtype, k))


def search_tree(tree: BoxTree, k: int, launch: Launch) -> tuple[Tensor, Tensor]:
    """The ``k`` nearest neighbours of every point of the tree, ordered by squared distance and then by index.

    ``launch`` runs the kernel compiled with :func:`kernel_options`. Indices, int64, and distances in scene units, both
    ``[N, k]``, are in the original order of the points.
    """
    n = len(tree.points)
    indices = torch.empty(n, k, dtype=torch.int64, device=tree.points.device)
    distances = tree.points.new_empty(n, k)
    arguments: list[Tensor | int | float] = [tree.points, tree.order, tree.boxes, tree.lowest]
    launch(n, [*arguments, n, tree.depth, torch.inf, indices, distances])
    return indices, distances


@dataclass(frozen=True, eq=False)
class BoxTree:
    """A complete binary tree in heap order: node 1 is the root, nodes 2 i and 2 i + 1 are the children of node i.

    There are ``L = 2^depth`` leaves, nodes L to 2 L - 1. Leaf ``j`` holds the rows ``floor(j N / L)`` to
    ``floor((j + 1) N / L) - 1`` of ``points``. Sizes of leaves differ by at most one and need not be stored.
    """

    points: Tensor  # Positions in the order of the leaves [N, 3]
    order: Tensor  # Original index of each point, int32 [N]; ascending among coincident points
    boxes: Tensor  # Lowest and highest coordinates of the points of each node [2 L, 6]; row 0 is unused
    lowest: Tensor  # Lowest original index among the points of each node, int32 [2 L]; row 0 is unused
    depth: int  # Levels below the root


def build_tree(points: Tensor) -> BoxTree:
    """Build the tree of finite points, float32 or float64 ``[N, 3]``, on their device; 130 bytes of scratch a point.

    Each level sorts all points at once, by segment and by rank along the segment's widest axis. Equal coordinates are
    ranked by index, so the result is the same in every run and on every device.
    """
    n = len(points)
    depth = max(0, (n // LEAF).bit_length() - 1)
    coordinates = points.detach().T.contiguous()
    position = torch.arange(n, device=points.device)
    order = position.to(torch.int32)
    ranks = torch.stack([_ranks(axis) for axis in coordinates])
    for level in range(depth):
        low, high = _bounds(coordinates, level)
        widest = (high - low).argmax(dim=0)
        segment = ((position + 1) * 2**level - 1) // n
        rank = ranks.gather(0, widest[segment][None]).squeeze(0)
        sorting = torch.sort(segment.mul_(n).add_(rank)).indices
        coordinates, ranks, order = coordinates[:, sorting], ranks[:, sorting], order[sorting]
    low, high = _bounds(coordinates, depth)
    lowest = _segments(order[None], depth).amin(dim=2).squeeze(0)
    # From the leaves to the root.
    boxes = coordinates.new_empty(2 ** (depth + 1), 6)
    all_lowest = order.new_empty(2 ** (depth + 1))
    boxes[0], all_lowest[0] = 0, 0
    for level in range(depth, -1, -1):
        nodes = slice(2**level, 2 ** (level + 1))
        boxes[nodes] = torch.cat([low, high]).T
        all_lowest[nodes] = lowest
        if level:
            low = torch.minimum(low[:, 0::2], low[:, 1::2])
            high = torch.maximum(high[:, 0::2], high[:, 1::2])
            lowest = torch.minimum(lowest[0::2], lowest[1::2])
    return BoxTree(coordinates.T.contiguous(), order, boxes, all_lowest, depth)


def _ranks(values: Tensor) -> Tensor:
    """Rank of each value in ascending order, lower index first among equals, int32 ``[N]``."""
    # Adding 0 turns -0 into 0: the two are equal, but a sort may separate them.
    order = torch.sort(values + 0.0, stable=True).indices
    ranks = torch.empty(len(values), dtype=torch.int32, device=values.device)
    ranks[order] = torch.arange(len(values), dtype=torch.int32, device=values.device)
    return ranks


def _segments(rows: Tensor, level: int) -> Tensor:
    """Split ``[C, N]`` into the segments of a level, ``[C, 2^level, most]``; shorter ones repeat their last value."""
    n, count = rows.shape[1], 2**level
    starts = torch.arange(count + 1, device=rows.device) * n // count
    positions = starts[:-1, None] + torch.arange(-(-n // count), device=rows.device)
    return rows[:, torch.minimum(positions, starts[1:, None] - 1)]


def _bounds(coordinates: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Lowest and highest coordinates of the segments of a level, both ``[3, 2^level]``."""
    segments = _segments(coordinates, level)
    return segments.amin(dim=2), segments.amax(dim=2)
