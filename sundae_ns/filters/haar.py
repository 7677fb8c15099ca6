"""The high-pass filter I - A, the low-pass filter I + A, and the magnitude of their response.

The graph shift is the random-walk matrix ``A = D^-1 W``: its largest eigenvalue is 1, as the paper asks, and its rows
sum to 1, so the high-pass response does not depend on where the origin of the signal lies.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.graphs import NeighborGraph

Isolated = Literal["nan", "zero"]

CHUNK_ELEMENTS = 2**21
"""Most elements of the gathered neighbours ``[rows, K, D]`` at a time: 8 MiB in float32, for a CPU's cache."""


def high_pass(graph: NeighborGraph, signal: Tensor, *, isolated: Isolated = "nan") -> Tensor:
    """Response of the high-pass filter, ``(I - A) x`` in the form ``sum_j A_ij (x_i - x_j)``.

    Differences are taken before anything is summed: the form ``x_i - sum_j A_ij x_j`` loses its digits in float32 when
    the signal has a large offset, as positions of a scene far from the origin do.

    The response of a node without neighbours is undefined (row i of A is 0 / 0). ``nan`` says so, and is the default
    because any number would be taken for a measurement: with 0, floaters would pass for the smoothest part of the field
    and fill the low half of a band selection. ``zero`` makes such a node its own neighbour (``A_ii = 1``), which keeps
    every row sum of A at 1.

    Args:
        graph: the graph, N nodes.
        signal: one or D values per node, floating, on the graph's device ``[N]`` or ``[N, D]``.
        isolated: response of nodes without neighbours.

    Returns:
        Response with the shape and dtype of ``signal``.

    Raises:
        ConfigError: ``isolated`` is unknown.
        DataError: the signal does not have one row per node.
    """
    if isolated not in get_args(Isolated):
        raise ConfigError(f"unknown value {isolated!r} for isolated nodes: use one of {', '.join(get_args(Isolated))}")
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
        # A product and a sum, not a matrix product: that one may be rounded to TF32 on a GPU.
        response[rows] = (shift[:, :, None] * differences).sum(dim=1)
    if isolated == "nan":
        response[alone] = torch.nan
    return response.reshape(signal.shape)


def low_pass(graph: NeighborGraph, signal: Tensor, *, isolated: Isolated = "nan") -> Tensor:
    """Response of the low-pass filter, ``(I + A) x = 2 x - (I - A) x``; arguments as in :func:`high_pass`.

    With ``isolated="zero"`` a node without neighbours is its own neighbour and responds with ``2 x``.
    """
    return 2 * signal - high_pass(graph, signal, isolated=isolated)


def response_magnitude(response: Tensor) -> Tensor:
    """Squared norm per node, ``pi_i = |f_i|^2``: float64 ``[N]`` from ``[N]`` or ``[N, D]``; NaN stays NaN.

    Squared in float64: in float32 the squares of a small scene vanish, and its nodes would all tie.
    """
    magnitude = torch.zeros(len(response), dtype=torch.float64, device=response.device)
    # Channel by channel, for a copy of them all in float64 would be the largest thing in memory.
    for channel in (response,) if response.ndim == 1 else response.unbind(dim=1):
        magnitude += channel.double().square()
    return magnitude
