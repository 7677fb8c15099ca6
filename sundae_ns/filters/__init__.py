"""Graph filters: the Haar-like ones of the paper and their response, and any kernel by Chebyshev polynomials. Floor 0.

The paper's filters (section "Graph Filtering and Sampling") are I - A and I + A, see :mod:`sundae_ns.filters.haar`.
"""

from sundae_ns.filters.chebyshev import cheby_filter, cheby_moments, compute_cheby_coeff, estimate_lmax, exact_filter
from sundae_ns.filters.coherence import local_coherence
from sundae_ns.filters.haar import Isolated, high_pass, low_pass, response_magnitude
from sundae_ns.filters.kernels import Kernel, band_pass_kernel, high_pass_kernel, low_pass_kernel

__all__ = [
    "Isolated",
    "Kernel",
    "band_pass_kernel",
    "cheby_filter",
    "cheby_moments",
    "compute_cheby_coeff",
    "estimate_lmax",
    "exact_filter",
    "high_pass",
    "high_pass_kernel",
    "local_coherence",
    "low_pass",
    "low_pass_kernel",
    "response_magnitude",
]
