"""Folding of spherical harmonics into a lower SH degree, and the view dependence of each primitive.

A colour is linear in its coefficients, so its mean over the views that see a primitive follows from the means of the
basis. Folding moves the mean of the removed degrees into degree 0: no other constant is nearer to the colours seen, in
the mean square (``E[(c - m)^2]`` is least at ``m = E[c]``).
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from sundae_ns.gaussians.parameters import SH_C0


def mean_basis(weighted: Iterable[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Mean and mean square of each basis function over views.

    Args:
        weighted: weights of the primitives ``[N]`` and basis in their directions ``[N, K]``, for each view.

    Returns:
        Mean and mean square ``[N, K]``; 0 for primitives that no view sees.
    """
    total = mean = square = torch.zeros(())
    for weight, basis in weighted:
        total = total + weight
        mean = mean + weight[:, None] * basis
        square = square + weight[:, None] * basis.square()
    scale = torch.where(total > 0, 1 / total, 0.0)[:, None]
    return mean * scale, square * scale


def fold_harmonics(features_dc: Tensor, features_rest: Tensor, mean: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """Remove the coefficients above SH degree ``degree``, and add their mean colour to degree 0.

    Args:
        features_dc: ``[N, 3]``.
        features_rest: ``[N, K - 1, 3]``.
        mean: mean of the basis over the views ``[N, K]``, degree 0 included.

    Returns:
        ``features_dc`` ``[N, 3]`` and ``features_rest`` ``[N, (degree + 1)^2 - 1, 3]``.
    """
    kept = (degree + 1) ** 2
    lost = torch.einsum("nk,nkc->nc", mean[:, kept:], features_rest[:, kept - 1 :])
    return features_dc + lost / SH_C0, features_rest[:, : kept - 1]


def view_dependence(features_rest: Tensor, mean: Tensor, square: Tensor, weight: Tensor) -> Tensor:
    """View dependence of each primitive in the rendered images ``[N]``.

    The variance of its colour over the views that see it, without cross terms between coefficients, times its weight.

    Args:
        features_rest: ``[N, K - 1, 3]``.
        mean, square: from :func:`mean_basis` ``[N, K]``.
        weight: summed blending weights ``[N]``.
    """
    variance = (square - mean.square()).clamp_min(0)[:, 1 : 1 + features_rest.shape[1]]
    return weight * torch.einsum("nk,nkc->n", variance, features_rest.square())
