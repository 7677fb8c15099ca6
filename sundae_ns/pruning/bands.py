"""Spherical harmonics that carry nothing: fold bands into the constant colour, and tell which primitives need none.

A colour is linear in its coefficients, so its mean over the views that see a primitive is the same sum with the means of
the basis. Folding a band away moves its mean into band 0: of all constants it is the one that is nearest to the colours
seen, in the mean square (``E[(c - m)^2]`` is least at ``m = E[c]``).
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from sundae_ns.gaussians.parameters import SH_C0


def mean_basis(weighted: Iterable[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Mean and mean square of each basis function over views.

    Args:
        weighted: for each view, the weight of each primitive in it ``[N]`` and the basis in its direction ``[N, K]``.

    Returns:
        Two tensors ``[N, K]``; 0 for primitives that no view sees.
    """
    total = mean = square = None
    for weight, basis in weighted:
        first, second = weight[:, None] * basis, weight[:, None] * basis.square()
        if total is None or mean is None or square is None:
            total, mean, square = weight.clone(), first, second
        else:
            total, mean, square = total + weight, mean + first, square + second
    assert total is not None
    assert mean is not None
    assert square is not None
    scale = torch.where(total > 0, 1 / total, 0.0)[:, None]
    return mean * scale, square * scale


def fold(features_dc: Tensor, features_rest: Tensor, mean: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """Take away the bands above ``degree``, their mean colour moved into band 0.

    Args:
        features_dc: ``[N, 3]``.
        features_rest: ``[N, K - 1, 3]``.
        mean: mean of the basis over the views ``[N, K]``, band 0 included.
        degree: highest band that stays.

    Returns:
        ``features_dc`` ``[N, 3]`` and ``features_rest`` ``[N, (degree + 1)^2 - 1, 3]``.
    """
    kept = (degree + 1) ** 2
    lost = torch.einsum("nk,nkc->nc", mean[:, kept:], features_rest[:, kept - 1 :])
    return features_dc + lost / SH_C0, features_rest[:, : kept - 1]


def view_dependence(features_rest: Tensor, mean: Tensor, square: Tensor, weight: Tensor) -> Tensor:
    """How much of the pictures the bands above 0 of each primitive make up ``[N]``.

    The variance of its colour over the views that see it, cross terms between bands left out, times its weight in them.

    Args:
        features_rest: ``[N, K - 1, 3]``.
        mean, square: from :func:`mean_basis` ``[N, K]``.
        weight: summed blending weights ``[N]``.
    """
    variance = (square - mean.square()).clamp_min(0)[:, 1 : 1 + features_rest.shape[1]]
    return weight * torch.einsum("nk,nkc->n", variance, features_rest.square())
