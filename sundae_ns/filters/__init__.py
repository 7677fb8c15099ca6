"""Graph filters: those of the paper, and the smooth part of a signal."""

from sundae_ns.filters.filters import Smoother, high_pass, low_pass, response_magnitude

__all__ = ["Smoother", "high_pass", "low_pass", "response_magnitude"]
