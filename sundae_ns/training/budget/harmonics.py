"""Fewer harmonics: bands that go for the whole field, and primitives that look the same from everywhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.nn import Parameter

from sundae_ns.gaussians.snapshot import narrow
from sundae_ns.pruning.bands import fold, view_dependence
from sundae_ns.training.budget.run import Run

TRIALS = 6
"""Looks that the bisection for the flat primitives takes."""


def leave_bands(run: Run, degree: int) -> None:
    """Drop the bands above ``degree``; what they added on average over the views goes into band 0."""
    dc, rest = run.params["features_dc"], run.params["features_rest"]
    mean, _ = run.view_basis(run.degree)
    dc.data.copy_(fold(dc.data, rest.data, mean, degree)[0])
    narrow(run.params, run.optimizers.optimizers, "features_rest", (degree + 1) ** 2 - 1)


def flatten(run: Run, least: float) -> Tensor:
    """Set the bands of those primitives to 0 that look the same from everywhere, as many as held-back views allow.

    Args:
        run: whose field has bands above 0.
        least: mean PSNR over the held-back views that has to be left, dB.

    Returns:
        True for the primitives whose bands were set to 0, bool ``[N]``.
    """
    dc, rest = run.params["features_dc"], run.params["features_rest"]
    weight = run.contribution()
    mean, square = run.view_basis(run.degree)
    order = view_dependence(rest.data, mean, square, weight).cpu().argsort(stable=True).to(rest.device)
    folded, _ = fold(dc.data, rest.data, mean, 0)

    def flattened(count: int) -> tuple[Tensor, Tensor, Tensor]:
        flat = torch.zeros(len(order), dtype=torch.bool, device=rest.device)
        flat[order[:count]] = True
        return flat, torch.where(flat[:, None], folded, dc.data), rest.data * ~flat[:, None, None]

    low, high = 0, len(order)
    for _ in range(TRIALS):
        middle = (low + high + 1) // 2
        _, colours, bands = flattened(middle)
        with _values(dc, colours), _values(rest, bands):
            good = run.measure() >= least
        low, high = (middle, high) if good else (low, middle)
    flat, colours, bands = flattened(low)
    dc.data.copy_(colours)
    rest.data.copy_(bands)
    return flat


@contextmanager
def _values(parameter: Parameter, value: Tensor) -> Iterator[None]:
    """Another value for a while."""
    before = parameter.data
    parameter.data = value
    try:
        yield
    finally:
        parameter.data = before
