"""Sparse matrices of a graph, in the vocabulary of graph signal processing (W, dw, L, lap_type)."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import scipy.sparse as sp

from sundae_ns.errors import ConfigError
from sundae_ns.graphs.graph import NeighborGraph

LapType = Literal["combinatorial", "normalized"]


def adjacency(graph: NeighborGraph) -> sp.csr_matrix:
    """Symmetric weighted adjacency W ``[N, N]``, float64.

    An edge is kept if either end found the other. The weight depends on the distance alone, so both ends agree on it.
    """
    weights = graph.weights.detach().cpu().double().numpy()
    columns = graph.indices.cpu().numpy()
    rows = np.broadcast_to(np.arange(graph.N)[:, None], columns.shape)
    present = weights > 0
    directed = sp.csr_matrix((weights[present], (rows[present], columns[present])), shape=(graph.N, graph.N))
    return directed.maximum(directed.T).tocsr()


def laplacian(graph: NeighborGraph, lap_type: LapType = "combinatorial") -> sp.csr_matrix:
    """Laplacian L of the symmetric adjacency ``[N, N]``, float64.

    ``combinatorial`` is ``D - W``; ``normalized`` is ``I - D^-1/2 W D^-1/2``, with zero rows for isolated nodes so that
    its kernel still counts the connected components.

    Raises:
        ConfigError: ``lap_type`` is unknown.
    """
    if lap_type not in get_args(LapType):
        raise ConfigError(f"unknown lap_type {lap_type!r}: use one of {', '.join(get_args(LapType))}")
    W = adjacency(graph)
    dw = np.asarray(W.sum(axis=1)).ravel()
    if lap_type == "combinatorial":
        return (sp.diags(dw) - W).tocsr()
    connected = dw > 0
    inverse_root = np.zeros_like(dw)
    inverse_root[connected] = dw[connected] ** -0.5
    return (sp.diags(connected.astype(np.float64)) - sp.diags(inverse_root) @ W @ sp.diags(inverse_root)).tocsr()
