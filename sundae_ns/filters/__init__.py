"""Graph filters of the paper (section "Graph Filtering and Sampling"): I - A, I + A, and the magnitude of a response.

See :mod:`sundae_ns.filters.haar`.
"""

from sundae_ns.filters.haar import high_pass, low_pass, response_magnitude

__all__ = ["high_pass", "low_pass", "response_magnitude"]
