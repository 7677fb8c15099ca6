"""How much of a graph's low band each node carries: the local coherence that samples of band-limited signals are drawn by.

A signal whose spectrum ends at the k-th eigenvalue lies in the span of the first k eigenvectors U_k. The energy of node i in
that span, ``nu_i^2 = |U_k^T delta_i|^2``, says how much of it is lost without node i; drawing nodes in proportion to it
needs the fewest samples for a stable reconstruction (Puy, Tremblay, Gribonval and Vandergheynst, "Random sampling of
bandlimited signals on graphs", 2018). No eigenvector is needed: with random vectors r of unit variance, the expected
square of the low-passed ``(H r)_i`` is ``sum_l h(lambda_l)^2 u_l(i)^2``.
"""

from __future__ import annotations

import math

import scipy.sparse as sp
import torch
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.filters.chebyshev import cheby_filter, cheby_moments, compute_cheby_coeff, estimate_lmax
from sundae_ns.filters.kernels import Kernel, low_pass_kernel

SOFTNESS = 0.5
"""Width of the kernel's transition as a share of its cutoff: a polynomial of a few dozen terms follows it down to
cutoffs of a thousandth of the spectrum."""

_BISECTIONS = 40


def local_coherence(
    L: sp.csr_matrix,
    rank: int,
    *,
    vectors: int = 24,
    order: int = 40,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Tensor:
    """Estimate the energy of each node in the ``rank`` lowest frequencies of a graph.

    The cutoff is where the trace of the kernel, as the same random vectors estimate it, is ``rank``: the band is as
    wide as the budget. Costs ``2 order`` sparse products with ``vectors`` columns.

    Args:
        L: symmetric positive semidefinite Laplacian ``[N, N]``.
        rank: dimension of the band, 1 to N.
        vectors: random vectors; the relative error of a value is about ``sqrt(2 / vectors)``.
        order: of the polynomials.
        seed: of the random vectors, which are drawn on the CPU: the same on every device.
        device: where the products are computed.

    Returns:
        Positive numbers that sum to ``rank``, float64, on the device ``[N]``. A node without edges is a component of its
        own, which nothing else tells about, and so has the most there is. Without any edge all are equal.

    Raises:
        ConfigError: ``rank`` or ``vectors`` is out of range.
    """
    n = L.shape[0]
    if not 1 <= rank <= n:
        raise ConfigError(f"a graph of {n} nodes has no band of {rank} frequencies: use 1 to {n}")
    if vectors < 1:
        raise ConfigError(f"{vectors} random vectors estimate nothing: use at least 1")
    lmax = estimate_lmax(L)
    if lmax == 0 or rank == n:
        return torch.full((n,), rank / n, dtype=torch.float64, device=device)
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(n, vectors, generator=generator, dtype=torch.float64).to(device)
    moments = cheby_moments(L, noise, order=order, lmax=lmax)
    kernel = low_pass_kernel_of_rank(moments, rank / n, lmax)
    energy = cheby_filter(L, noise, kernel, order=order, lmax=lmax).square().mean(dim=1)
    return energy * (rank / energy.sum())


def low_pass_kernel_of_rank(moments: Tensor, share: float, lmax: float) -> Kernel:
    """The soft low pass whose gains, squared, sum to a share of the number of nodes.

    Args:
        moments: of the spectrum, see :func:`sundae_ns.filters.cheby_moments` ``[order + 1]``.
        share: of the nodes, in (0, 1).
        lmax: end of the spectrum, positive.
    """
    low, high = 1e-6, 1.0
    for _ in range(_BISECTIONS):
        cutoff = math.sqrt(low * high)
        if _mean_gain(low_pass_kernel(lmax, cutoff, SOFTNESS * cutoff), moments, lmax) < share:
            low = cutoff
        else:
            high = cutoff
    return low_pass_kernel(lmax, high, SOFTNESS * high)


def _mean_gain(kernel: Kernel, moments: Tensor, lmax: float) -> float:
    """Mean of the squared gains over all frequencies."""
    return float(compute_cheby_coeff(lambda x: kernel(x).square(), lmax, len(moments) - 1) @ moments)
