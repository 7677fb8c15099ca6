"""Graph filters: those of the paper, I - A, I + A and the magnitude of a response, and the smooth part of a signal.

The graph shift is the random-walk matrix ``A = D^-1 W``. Its largest eigenvalue is 1, as the paper requires. Its rows
sum to 1, so the high-pass response does not depend on the origin of the signal.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.errors import DataError
from sundae_ns.graph.graph import NeighborGraph

CHUNK_ELEMENTS = 2**21
"""Most gathered neighbours ``[rows, K, D]`` at a time, in elements: 8 MiB in float32, to fit a CPU's cache."""


def high_pass(graph: NeighborGraph, signal: Tensor) -> Tensor:
    """Response of the high-pass filter ``[N, ...]``, ``(I - A) x`` in the form ``sum_j A_ij (x_i - x_j)``.

    Differences are taken before the sum: the form ``x_i - sum_j A_ij x_j`` loses digits in float32 if the signal has a
    large offset, as in a scene far from the origin.

    The response of a node without neighbours is undefined (row i of A is 0 / 0), so it is NaN. With 0, floaters would
    look like the smoothest part of the field and fill the low end of a band selection. ``DataError`` for other rows.
    """
    if signal.ndim not in (1, 2) or signal.shape[0] != graph.N:
        raise DataError(f"signal has shape {list(signal.shape)} on a graph of {graph.N} nodes: pass [N] or [N, D]")
    values = signal[:, None] if signal.ndim == 1 else signal
    response = torch.empty_like(values)
    alone = graph.isolated
    degree = torch.where(alone, torch.ones_like(graph.dw), graph.dw).to(values.dtype)
    step = max(1, CHUNK_ELEMENTS // max(1, graph.indices.shape[1] * values.shape[1]))
    for start in range(0, graph.N, step):
        rows = slice(start, start + step)
        shift = graph.weights[rows].to(values.dtype) / degree[rows, None]
        differences = values[rows, None] - values[graph.indices[rows]]
        # A product and a sum: a matrix product may be rounded to TF32 on a GPU.
        response[rows] = (shift[:, :, None] * differences).sum(dim=1)
    response[alone] = torch.nan
    return response.reshape(signal.shape)


def response_magnitude(response: Tensor) -> Tensor:
    """Squared norm per node, ``pi_i = |f_i|^2``: float64 ``[N]`` from ``[N]`` or ``[N, D]``; NaN stays NaN.

    Squares are float64: in float32 those of a small scene underflow, and all nodes tie.
    """
    magnitude = torch.zeros(len(response), dtype=torch.float64, device=response.device)
    # Channel by channel: a float64 copy of all channels would set the peak of memory.
    for channel in (response,) if response.ndim == 1 else response.unbind(dim=1):
        magnitude += channel.double().square()
    return magnitude


class Smoother:
    """The low-pass filter ``(M + strength L)^-1 M`` of a graph, whose weights in both directions may differ.

    L is the Laplacian over the mean degree, of weights that are the mean of both directions, and M is diagonal: 1 for
    nodes with a known value, else 0. The result x minimises the squared differences to the signal over known nodes,
    plus ``strength x^T L x`` (Shuman et al., IEEE Signal Processing Magazine 2013, section III). Columns of L sum to 0,
    so over known nodes x and the signal have the same mean: the high-pass response ``y - x`` sums to 0. A ``strength``
    of 0 leaves a signal as it is; a large one makes it constant on each connected part.
    """

    def __init__(self, graph: NeighborGraph, strength: float) -> None:
        from scipy.sparse import csr_array, dia_array, linalg  # take half a second, also where nothing is smoothed

        n, k = graph.indices.shape
        self._factors = linalg.splu
        self._diagonal = lambda values: dia_array((values[None], [0]), shape=(n, n))
        entries = (np.repeat(np.arange(n), k), graph.indices.cpu().numpy().ravel())
        directed = csr_array((graph.weights.detach().double().cpu().numpy().ravel(), entries), shape=(n, n))
        weights = 0.5 * (directed + directed.T)
        degrees = np.asarray(weights.sum(axis=1)).ravel()
        scale = strength / degrees.mean() if degrees.any() else 0.0
        self._laplacian = scale * (self._diagonal(degrees) - weights)
        self._known: NDArray[np.bool_] | None = None

    def __call__(self, signal: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
        """The smooth part of a signal ``[N, D]``, read where a node is known, bool ``[N]``; a value for every node."""
        if self._known is None or (known != self._known).any():  # factors are kept, as few calls change the nodes
            # Unknown values have a small weight: one without a path to a known value would have no equation.
            self._solve = self._factors((self._diagonal(np.maximum(known, 1e-9)) + self._laplacian).tocsc()).solve
            self._known = known.copy()
        smooth: NDArray[np.float64] = self._solve(np.where(known[:, None], signal, 0.0))
        return smooth
