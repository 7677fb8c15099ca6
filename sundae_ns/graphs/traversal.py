"""Neighbour search in a tree of boxes by ``csrc/neighbors.cu``, one thread per point."""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import Launch
from sundae_ns.graphs.tree import BoxTree

FILE, KERNEL = "neighbors.cu", "nearest"
"""Source file and name of the kernel."""

MAX_NEIGHBORS = 128
"""Most neighbours that the kernel supports; lists of up to about 32 stay in registers."""

BLOCK = 128
"""Threads per block."""

OPTIONS = ("--fmad=false",)
"""Compiler options. Fused multiply-adds round differently: distances would differ from the CPU's in the last bit."""


def definitions(dtype: torch.dtype, k: int) -> tuple[str, ...]:
    """Compiler options that set the type of the coordinates and the number of neighbours in the source."""
    return (f"-DREAL={'double' if dtype == torch.float64 else 'float'}", f"-DK={k}")


def search_tree(tree: BoxTree, k: int, launch: Launch) -> tuple[Tensor, Tensor]:
    """The ``k`` nearest neighbours of every point of the tree, ordered by squared distance and then by index.

    Args:
        tree: the points.
        k: number of neighbours, 1 to :data:`MAX_NEIGHBORS` and less than N.
        launch: runs the kernel compiled with :func:`definitions` for the tree's dtype and ``k``.

    Returns:
        Indices, int64 ``[N, k]``, and ascending distances in scene units, dtype of the tree ``[N, k]``; rows are in the
        original order of the points.
    """
    n = len(tree.points)
    indices = torch.empty(n, k, dtype=torch.int64, device=tree.points.device)
    distances = tree.points.new_empty(n, k)
    arguments: list[Tensor | int | float] = [tree.points, tree.order, tree.boxes, tree.lowest]
    launch(n, [*arguments, n, tree.depth, torch.inf, indices, distances])
    return indices, distances
