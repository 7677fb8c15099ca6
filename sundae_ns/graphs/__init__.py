"""Neighbour graphs on the centres of primitives (paper, "Graph Construction"): exact search and edge weights."""

from sundae_ns.graphs.graph import NeighborGraph, build_graph
from sundae_ns.graphs.neighbors import knn

__all__ = ["NeighborGraph", "build_graph", "knn"]
