"""Haar-like graph filters of the paper (section "Graph Filtering and Sampling") and their response. Floor 0."""

from sundae_ns.filters.haar import Isolated, high_pass, low_pass, response_magnitude

__all__ = ["Isolated", "high_pass", "low_pass", "response_magnitude"]
