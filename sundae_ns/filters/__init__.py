"""Graph filters: those of the paper (I - A, I + A and the magnitude of a response; :mod:`sundae_ns.filters.haar`), and
the smooth part of a signal (:mod:`sundae_ns.filters.smoothing`).
"""

from sundae_ns.filters.haar import high_pass, low_pass, response_magnitude
from sundae_ns.filters.smoothing import Smoother

__all__ = ["Smoother", "high_pass", "low_pass", "response_magnitude"]
