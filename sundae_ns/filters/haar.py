"""The high-pass filter I - A, the low-pass filter I + A, and the magnitude of their response.

The graph shift is the random-walk matrix ``A = D^-1 W``. Its largest eigenvalue is 1, as the paper requires. Its rows
sum to 1, so the high-pass response does not depend on the origin of the signal.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.graphs import NeighborGraph

CHUNK_ELEMENTS = 2**21
"""Most gathered neighbours ``[rows, K, D]`` at a time, in elements: 8 MiB in float32, to fit a CPU's cache."""


def high_pass(graph: NeighborGraph, signal: Tensor) -> Tensor:
    """Response of the high-pass filter, ``(I - A) x`` in the form ``sum_j A_ij (x_i - x_j)``.

    Differences are taken before the sum: the form ``x_i - sum_j A_ij x_j`` loses digits in float32 if the signal has a
    large offset, as in a scene far from the origin.

    The response of a node without neighbours is undefined (row i of A is 0 / 0), so it is NaN. With 0, floaters would
    look like the smoothest part of the field and fill the low end of a band selection.

    Args:
        graph: the graph, N nodes.
        signal: one or D values per node, floating, on the graph's device ``[N]`` or ``[N, D]``.

    Returns:
        Response with the shape and dtype of ``signal``; NaN for nodes without neighbours.

    Raises:
        DataError: the signal does not have one row per node.
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


def low_pass(graph: NeighborGraph, signal: Tensor) -> Tensor:
    """Response of the low-pass filter, ``(I + A) x = 2 x - (I - A) x``; arguments as in :func:`high_pass`."""
    return 2 * signal - high_pass(graph, signal)


def response_magnitude(response: Tensor) -> Tensor:
    """Squared norm per node, ``pi_i = |f_i|^2``: float64 ``[N]`` from ``[N]`` or ``[N, D]``; NaN stays NaN.

    Squares are float64: in float32 those of a small scene underflow, and all nodes tie.
    """
    magnitude = torch.zeros(len(response), dtype=torch.float64, device=response.device)
    # Channel by channel: a float64 copy of all channels would set the peak of memory.
    for channel in (response,) if response.ndim == 1 else response.unbind(dim=1):
        magnitude += channel.double().square()
    return magnitude
