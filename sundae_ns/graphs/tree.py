"""A balanced tree of boxes over points, built with torch on the points' device, for the search on a GPU.

Points are split at the median of the widest axis of their box, level by level, until at most 16 are left. Medians adapt
to any spread: clusters of 1e-5 beside a background of 1e3, or a floater at 1e20, cost no resolution. A uniform grid or
a Morton code would lose it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LEAF = 8
"""Fewest points of a leaf if the tree has several; leaves hold fewer than twice as many."""


@dataclass(frozen=True, eq=False)
class BoxTree:
    """A complete binary tree in heap order: node 1 is the root, nodes 2 i and 2 i + 1 are the children of node i.

    There are ``L = 2^depth`` leaves, nodes L to 2 L - 1. Leaf ``j`` holds the rows ``floor(j N / L)`` to
    ``floor((j + 1) N / L) - 1`` of ``points``. Sizes of leaves differ by at most one and need not be stored.
    """

    points: Tensor
    """Positions in the order of the leaves ``[N, 3]``."""
    order: Tensor
    """Original index of each point, int32 ``[N]``; ascending among coincident points."""
    boxes: Tensor
    """Lowest and highest coordinates of the points of each node ``[2 L, 6]``; row 0 is unused."""
    lowest: Tensor
    """Lowest original index among the points of each node, int32 ``[2 L]``; row 0 is unused."""
    depth: int
    """Levels below the root."""


def build_tree(points: Tensor) -> BoxTree:
    """Build the tree.

    Each level sorts all points at once, by segment and by rank along the segment's widest axis. Equal coordinates are
    ranked by index, so the result is the same in every run and on every device.

    Args:
        points: finite positions, float32 or float64, at least one ``[N, 3]``.

    Returns:
        The tree, with the dtype and device of the points. Scratch memory is about 130 bytes per point in float32.
    """
    n = len(points)
    depth = max(0, (n // LEAF).bit_length() - 1)
    coordinates = points.detach().T.contiguous()
    place = torch.arange(n, device=points.device)
    order = place.to(torch.int32)
    ranks = torch.stack([_ranks(axis) for axis in coordinates])
    for level in range(depth):
        low, high = _bounds(coordinates, level)
        widest = (high - low).argmax(dim=0)
        segment = ((place + 1) * 2**level - 1) // n
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
    most = -(-n // count)
    places = starts[:-1, None] + torch.arange(most, device=rows.device)
    return rows[:, torch.minimum(places, starts[1:, None] - 1)]


def _bounds(coordinates: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Lowest and highest coordinates of the segments of a level, both ``[3, 2^level]``."""
    segments = _segments(coordinates, level)
    return segments.amin(dim=2), segments.amax(dim=2)
