"""Filters of any kernel: by Chebyshev polynomials of the Laplacian, and by its eigenvectors as the oracle.

A polynomial of order K reaches K edges far and costs K products of the sparse Laplacian with the signal; no eigenvector
is needed (Hammond, Vandergheynst and Gribonval, "Wavelets on graphs via spectral graph theory", 2011).
"""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse as sp
import torch
from scipy.sparse.linalg import ArpackNoConvergence, eigsh
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.filters.kernels import Kernel

MOST_EXACT_NODES = 4096
"""Largest graph that :func:`exact_filter` takes: 128 MiB a dense matrix, and some ten seconds."""

_DENSE = 64
"""Up to this many nodes all eigenvalues are found; Lanczos needs a few to start from."""


def estimate_lmax(L: sp.csr_matrix) -> float:
    """An upper estimate of the largest eigenvalue of a Laplacian.

    Lanczos to a relative accuracy of 1e-3, and half a percent more, because polynomials explode outside of the interval
    that they are made for; but never more than the largest absolute row sum (Gershgorin). The start vector is fixed, so
    the estimate is the same from run to run.

    Args:
        L: symmetric positive semidefinite matrix ``[N, N]``.

    Returns:
        The estimate; 0 for a graph without edges, or without nodes.

    Raises:
        DataError: the matrix is not square, or not finite.
    """
    _check_matrix(L)
    n = L.shape[0]
    bound = float(abs(L).sum(axis=1).max()) if n else 0.0
    if not math.isfinite(bound):
        raise DataError("the Laplacian is not finite: build it from finite weights")
    if bound == 0:
        return 0.0
    if n <= _DENSE:
        largest = float(np.linalg.eigvalsh(L.toarray())[-1])
    else:
        start = np.random.default_rng(0).standard_normal(n)
        try:
            largest = float(eigsh(L, k=1, which="LA", tol=1e-3, v0=start, return_eigenvectors=False)[0])
        except ArpackNoConvergence:
            return bound
    return min(1.005 * largest, bound)


def compute_cheby_coeff(kernel: Kernel, lmax: float, order: int = 30) -> Tensor:
    """Coefficients of the kernel's Chebyshev series on [0, lmax], ``sum_j c_j T_j(2 lambda / lmax - 1)``.

    By the cosine sum on the nodes of a polynomial of twice the order and at least 64 more, so that aliasing stays below
    the error of cutting the series.

    Args:
        kernel: the gain.
        lmax: end of the interval, at least 0.
        order: order of the polynomial, at least 0.

    Returns:
        Coefficients, float64 ``[order + 1]``.

    Raises:
        ConfigError: ``order`` or ``lmax`` is negative.
        DataError: the kernel is not finite on the interval.
    """
    if order < 0:
        raise ConfigError(f"order is {order}: use at least 0")
    if not (lmax >= 0 and math.isfinite(lmax)):
        raise ConfigError(f"lmax is {lmax}: use a finite number of at least 0, estimate_lmax(L) gives one")
    count = 2 * (order + 1) + 64
    angles = math.pi * (torch.arange(count, dtype=torch.float64) + 0.5) / count
    gains = kernel(0.5 * lmax * (torch.cos(angles) + 1))
    if not torch.isfinite(gains).all():
        raise DataError(f"the kernel is not finite on [0, {lmax}]: use another")
    coefficients = 2 / count * torch.cos(torch.arange(order + 1, dtype=torch.float64)[:, None] * angles) @ gains
    coefficients[0] /= 2
    return coefficients


def cheby_filter(
    L: sp.csr_matrix, signal: Tensor, kernel: Kernel, *, order: int = 30, lmax: float | None = None
) -> Tensor:
    """Filter a signal by the kernel's Chebyshev polynomial of the Laplacian.

    For a symmetric L and a polynomial p the error ``|p(L) x - kernel(L) x|`` is at most ``|x|`` times the largest
    difference of p and kernel on [0, lmax].

    Args:
        L: Laplacian; see :func:`sundae_ns.graphs.laplacian` ``[N, N]``.
        signal: one or D values a node, floating, any device ``[N]`` or ``[N, D]``.
        kernel: the gain; a node without edges is multiplied by the gain at 0.
        order: of the polynomial.
        lmax: end of the interval; at least the largest eigenvalue. ``estimate_lmax(L)`` where it is not given.

    Returns:
        The filtered signal, with the shape, dtype and device of ``signal``; computed in float64.

    Raises:
        ConfigError: ``order`` or ``lmax`` cannot be used.
        DataError: matrix and signal do not fit.
    """
    values = _check_signal(L, signal)
    lmax = estimate_lmax(L) if lmax is None else lmax
    coefficients = compute_cheby_coeff(kernel, lmax, order).tolist()
    if lmax == 0:
        # All eigenvalues are 0, and so the series is its value at 0, where T_j is 1 or -1 by turns.
        gain = sum(c * (-1) ** j for j, c in enumerate(coefficients))
        return (gain * values).to(signal.dtype).reshape(signal.shape)
    # T_j of (2 / lmax) L - I, by T_j = 2 x T_(j-1) - T_(j-2).
    shifted = _operator((2 / lmax * L - sp.identity(L.shape[0])).tocsr(), signal.device)
    previous, current = values, _product(shifted, values)
    filtered = coefficients[0] * values
    for j, coefficient in enumerate(coefficients[1:], start=1):
        filtered.add_(current, alpha=coefficient)
        if j < order:
            previous, current = current, _product(shifted, current).mul_(2).sub_(previous)
    return filtered.to(signal.dtype).reshape(signal.shape)


def cheby_moments(L: sp.csr_matrix, probes: Tensor, *, order: int, lmax: float) -> Tensor:
    """Moments of a graph's spectrum, ``tr T_j(2 L / lmax - I) / N`` for j up to ``order``, by random probes (Hutchinson).

    With the coefficients of a kernel they give the mean of its gains over all frequencies: ``c @ moments``.

    Args:
        L: Laplacian ``[N, N]``.
        probes: independent values of unit variance, any device ``[N, D]``.
        order: highest moment, at least 0.
        lmax: end of the spectrum, positive.

    Returns:
        Moments relative to that of order 0, float64, on the CPU ``[order + 1]``.
    """
    values = _check_signal(L, probes)
    shifted = _operator((2 / lmax * L - sp.identity(L.shape[0])).tocsr(), probes.device)
    previous, current = values, _product(shifted, values)
    moments = [(values * values).sum(), (values * current).sum()]
    while len(moments) <= order:
        previous, current = current, _product(shifted, current).mul_(2).sub_(previous)
        moments.append((values * current).sum())
    return (torch.stack(moments[: order + 1]) / moments[0]).cpu()


def exact_filter(L: sp.csr_matrix, signal: Tensor, kernel: Kernel) -> Tensor:
    """Filter a signal by eigendecomposition, ``U kernel(lambda) U^T x``: the oracle, for small graphs.

    Args:
        L: symmetric Laplacian ``[N, N]``.
        signal: as in :func:`cheby_filter`.
        kernel: the gain.

    Returns:
        The filtered signal, with the shape, dtype and device of ``signal``; computed in float64.

    Raises:
        ConfigError: the graph has more than :data:`MOST_EXACT_NODES` nodes.
        DataError: matrix and signal do not fit.
    """
    values = _check_signal(L, signal)
    if len(values) > MOST_EXACT_NODES:
        raise ConfigError(
            f"{len(values)} nodes are too many to find all eigenvectors of: use cheby_filter, or at most {MOST_EXACT_NODES}"
        )
    eigenvalues, U = torch.linalg.eigh(torch.from_numpy(L.toarray()).double())
    # Rounding leaves zeros a little below 0, where a kernel need not be defined.
    gains = kernel(eigenvalues.clamp_min(0))
    filtered = U @ (gains[:, None] * (U.T @ values.cpu()))
    return filtered.to(signal.device, signal.dtype).reshape(signal.shape)


def _operator(matrix: sp.csr_matrix, device: torch.device) -> sp.csr_matrix | Tensor:
    """The matrix in the form that multiplies on the device."""
    if device.type == "cpu":
        return matrix
    starts, columns, weights = (torch.from_numpy(x).to(device) for x in (matrix.indptr, matrix.indices, matrix.data))
    return torch.sparse_csr_tensor(starts, columns, weights, size=matrix.shape)


def _product(matrix: sp.csr_matrix | Tensor, values: Tensor) -> Tensor:
    return matrix @ values if isinstance(matrix, Tensor) else torch.from_numpy(matrix @ values.numpy())


def _check_matrix(L: sp.csr_matrix) -> None:
    if L.ndim != 2 or L.shape[0] != L.shape[1]:
        raise DataError(f"the Laplacian has shape {list(L.shape)}: pass a square one")


def _check_signal(L: sp.csr_matrix, signal: Tensor) -> Tensor:
    """The signal in float64, contiguous ``[N, D]``."""
    _check_matrix(L)
    if signal.ndim not in (1, 2) or len(signal) != L.shape[0]:
        raise DataError(f"signal has shape {list(signal.shape)} on a graph of {L.shape[0]} nodes: pass [N] or [N, D]")
    values = signal[:, None] if signal.ndim == 1 else signal
    return values.detach().double().contiguous()
