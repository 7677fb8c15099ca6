"""Fewer SH coefficients: a lower degree for the whole field, and view-independent colours for single primitives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.nn import Parameter

from sundae_ns.gaussians.sh_folding import fold, view_dependence
from sundae_ns.gaussians.snapshot import narrow
from sundae_ns.training.budget.searched_field import SearchedField

TRIALS = 6
"""Steps of the bisection for the number of view-independent primitives."""


def lower_degree(searched: SearchedField, degree: int) -> None:
    """Drop the coefficients above ``degree``; their mean over the views moves into the constant colour."""
    field = searched.field
    dc, rest = field["features_dc"], field["features_rest"]
    mean, _ = searched.mean_basis(field.sh_degree)
    dc.data.copy_(fold(dc.data, rest.data, mean, degree)[0])
    narrow(field, searched.state.optimizers, "features_rest", (degree + 1) ** 2 - 1)


def flatten(searched: SearchedField, least: float) -> Tensor:
    """Give view-independent colours to as many primitives as held-out views allow, the least view-dependent first.

    Args:
        least: mean PSNR over the held-out views to keep, dB.

    Returns:
        True for the primitives whose higher coefficients are now 0, bool ``[N]``.
    """
    field = searched.field
    dc, rest = field["features_dc"], field["features_rest"]
    weight = searched.contribution()
    mean, square = searched.mean_basis(field.sh_degree)
    order = view_dependence(rest.data, mean, square, weight).cpu().argsort(stable=True).to(rest.device)
    folded, _ = fold(dc.data, rest.data, mean, 0)

    def flattened(count: int) -> tuple[Tensor, Tensor, Tensor]:
        flat = torch.zeros(len(order), dtype=torch.bool, device=rest.device)
        flat[order[:count]] = True
        return flat, torch.where(flat[:, None], folded, dc.data), rest.data * ~flat[:, None, None]

    low, high = 0, len(order)
    for _ in range(TRIALS):
        middle = (low + high + 1) // 2
        _, colors, coefficients = flattened(middle)
        with _values(dc, colors), _values(rest, coefficients):
            good = searched.measure() >= least
        low, high = (middle, high) if good else (low, middle)
    flat, colors, coefficients = flattened(low)
    dc.data.copy_(colors)
    rest.data.copy_(coefficients)
    return flat


@contextmanager
def _values(parameter: Parameter, value: Tensor) -> Iterator[None]:
    """Give a parameter another value for the length of a block."""
    before = parameter.data
    parameter.data = value
    try:
        yield
    finally:
        parameter.data = before
