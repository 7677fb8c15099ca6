"""Neighbour graphs on the centres of primitives: exact search, edge weights, degree and matrices. Floor 0.

The graph of the paper (section "Graph Construction") joins near primitives with Gaussian weights. It is stored as the
fixed number of neighbours of every primitive, so memory grows with N and never with N squared.
"""

from sundae_ns.graphs.bandwidth import Bandwidth, BandwidthRule, bandwidth
from sundae_ns.graphs.graph import NeighborGraph, build_graph, graph_from_neighbors
from sundae_ns.graphs.matrices import LapType, adjacency, laplacian
from sundae_ns.graphs.neighbors import Neighbors, knn, radius_neighbors

__all__ = [
    "Bandwidth",
    "BandwidthRule",
    "LapType",
    "NeighborGraph",
    "Neighbors",
    "adjacency",
    "bandwidth",
    "build_graph",
    "graph_from_neighbors",
    "knn",
    "laplacian",
    "radius_neighbors",
]
