"""Neighbour graphs on the centres of primitives: exact search, edge weights and degree.

The graph of the paper (section "Graph Construction") joins near primitives with Gaussian weights. It stores a fixed number
of neighbours per primitive, so memory grows with N and not with N squared.
"""

from sundae_ns.graphs.bandwidth import Bandwidth, BandwidthRule, bandwidth
from sundae_ns.graphs.graph import NeighborGraph, build_graph
from sundae_ns.graphs.neighbors import Neighbors, knn

__all__ = [
    "Bandwidth",
    "BandwidthRule",
    "NeighborGraph",
    "Neighbors",
    "bandwidth",
    "build_graph",
    "knn",
]
