"""Gains of graph filters as functions of the graph frequency, on [0, lmax]."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError

Kernel = Callable[[Tensor], Tensor]
"""Gain at eigenvalues of the Laplacian, elementwise: float64 ``[M]`` to float64 ``[M]``."""


def low_pass_kernel(lmax: float, cutoff: float = 0.5, width: float = 0.1) -> Kernel:
    """Gain 1 below the cutoff and 0 above it: ``erfc((x - cutoff) / width) / 2`` at ``x = lambda / lmax``.

    The error function has a derivative of every order everywhere, so that the Chebyshev series falls off faster than
    any geometric one; a step would ring at every order.

    Args:
        lmax: largest eigenvalue of the Laplacian, positive.
        cutoff: where the gain is one half, as a share of ``lmax``.
        width: of the transition, as a share of ``lmax``: from 0.92 to 0.08 within one width to either side.

    Raises:
        ConfigError: ``lmax`` or ``width`` is not positive, or ``cutoff`` not in [0, 1].
    """
    _check(lmax, width, cutoff)
    return lambda eigenvalues: 0.5 * torch.special.erfc((eigenvalues / lmax - cutoff) / width)


def high_pass_kernel(lmax: float, cutoff: float = 0.5, width: float = 0.1) -> Kernel:
    """Gain 0 below the cutoff and 1 above it: one less the gain of :func:`low_pass_kernel`."""
    _check(lmax, width, cutoff)
    return lambda eigenvalues: 0.5 * torch.special.erfc((cutoff - eigenvalues / lmax) / width)


def band_pass_kernel(lmax: float, low: float = 0.25, high: float = 0.75, width: float = 0.1) -> Kernel:
    """Gain 1 between two cutoffs: the difference of two low passes; arguments as in :func:`low_pass_kernel`.

    With low and high passes of the same cutoffs it adds up to 1 at every frequency.

    Raises:
        ConfigError: as there, or ``low`` is not below ``high``.
    """
    _check(lmax, width, low, high)
    if not low < high:
        raise ConfigError(f"the band from {low} to {high} is empty: let it begin below its end")
    below, up_to = low_pass_kernel(lmax, low, width), low_pass_kernel(lmax, high, width)
    return lambda eigenvalues: up_to(eigenvalues) - below(eigenvalues)


def _check(lmax: float, width: float, *cutoffs: float) -> None:
    for name, value in (("lmax", lmax), ("width", width)):
        if not (value > 0 and math.isfinite(value)):
            raise ConfigError(f"{name} is {value}: use a positive number")
    for cutoff in cutoffs:
        if not 0 <= cutoff <= 1:
            raise ConfigError(f"cutoff is {cutoff}: use a share of lmax, in [0, 1]")
