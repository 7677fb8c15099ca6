"""Neighbour graphs on the centres of primitives: exact search, edge weights and degree.

The graph of the paper (section "Graph Construction") joins near primitives with Gaussian weights. It stores a fixed
number of neighbours per primitive, so memory grows with N and not with N squared.
"""

from sundae_ns.graphs.graph import NeighborGraph, build_graph
from sundae_ns.graphs.neighbors import knn

__all__ = ["NeighborGraph", "build_graph", "knn"]
