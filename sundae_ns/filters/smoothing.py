"""The smooth part of a signal on a graph, by Tikhonov regularisation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, dia_array
from scipy.sparse.linalg import splu

from sundae_ns.graphs import NeighborGraph

_WITHOUT_EQUATION = 1e-9
"""Weight of unknown values: one without a path to a known value has no equation, and becomes 0."""


class Smoother:
    """The low-pass filter ``(M + strength L)^-1 M`` of a graph.

    L is the Laplacian over the mean degree, of weights that are the mean of both directions, and M is diagonal: 1 for
    nodes with a known value, else 0. The result x minimises the squared differences to the signal over known nodes,
    plus ``strength x^T L x`` (Shuman et al., IEEE Signal Processing Magazine 2013, section III). Columns of L sum to 0,
    so over known nodes x and the signal have the same mean: the high-pass response ``y - x`` sums to 0.

    Args:
        graph: its nodes; weights in both directions may differ.
        strength: 0 leaves a signal as it is; a large one makes it constant on each connected part.
    """

    def __init__(self, graph: NeighborGraph, strength: float) -> None:
        n, k = graph.indices.shape
        values, columns = graph.weights.detach().double().cpu().numpy().ravel(), graph.indices.cpu().numpy().ravel()
        directed = csr_array((values, (np.repeat(np.arange(n), k), columns)), shape=(n, n))
        weights = 0.5 * (directed + directed.T)
        degrees = np.asarray(weights.sum(axis=1)).ravel()
        scale = strength / degrees.mean() if degrees.any() else 0.0
        self._laplacian = scale * (_diagonal(degrees) - weights)
        self._known: NDArray[np.bool_] | None = None

    def __call__(self, signal: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
        """The smooth part.

        Args:
            signal: D values for each node; those of unknown nodes are not read ``[N, D]``.
            known: nodes with a value ``[N]``.

        Returns:
            A value for each node, also for unknown ones ``[N, D]``.
        """
        if self._known is None or (known != self._known).any():  # factors are kept, as few calls change the nodes
            self._solve = splu((_diagonal(np.maximum(known, _WITHOUT_EQUATION)) + self._laplacian).tocsc()).solve
            self._known = known.copy()
        smooth: NDArray[np.float64] = self._solve(np.where(known[:, None], signal, 0.0))
        return smooth


def _diagonal(values: NDArray[np.float64]) -> dia_array:
    return dia_array((values[None], [0]), shape=(len(values), len(values)))
