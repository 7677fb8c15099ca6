"""Fewer SH coefficients: a lower degree for the field, by trials, and view-independent colours for some primitives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn import Parameter

from sundae_ns.gaussians.sh_folding import fold_harmonics, view_dependence
from sundae_ns.gaussians.surgery import narrow
from sundae_ns.training.budget.search import NO_IMAGE
from sundae_ns.training.budget.searched_field import SearchedField

TRIAL_EVALUATIONS = 3
"""Length of the training at one SH degree, in evaluations."""
BISECTIONS = 6
"""Steps of the bisection for the number of view-independent primitives."""


def start_trial(searched: SearchedField, degree: int) -> None:
    """Train on from the warm-up field at an SH degree."""
    search = searched.search
    if degree < search.degree:
        lower_degree(searched, degree)
        search.degree = degree
    search.cut_at = searched.state.schedule_step


def trained(searched: SearchedField) -> bool:
    """Whether a trial has been trained as long as all others."""
    return searched.state.schedule_step - searched.search.cut_at >= TRIAL_EVALUATIONS * searched.config.search_every


def end_trial(searched: SearchedField) -> bool:
    """Measure a trial, and start the next one; returns whether there is none, and the field has the chosen degree."""
    search, tolerated = searched.search, searched.config.tolerated_drop
    steps = searched.state.schedule_step - search.cut_at
    if trained(searched):
        value = search.degrees[str(search.degree)] = searched.measure_finite()
        top = max(int(name) for name in search.degrees)
        if search.degree == search.lowest_degree(top, tolerated):
            if value > NO_IMAGE:
                searched.keep("accepted")
            else:
                searched.engine.kept["accepted"] = searched.engine.kept["fallback"]
        degree = search.next_degree(top, tolerated)
        if len(search.degrees) > 1 or value == NO_IMAGE:  # this trial, or the one that it has replaced
            search.steps_lost += steps
        if degree is not None:
            searched.go_back("fallback")
            start_trial(searched, degree)
            return False
        if search.degree != search.lowest_degree(top, tolerated) or value == NO_IMAGE:
            searched.go_back("accepted")
    elif search.degrees:  # the run ends during the trial; the warm-up's own degree needs no proof
        search.steps_lost += steps
        searched.go_back("accepted")
    del searched.engine.kept["fallback"]
    if search.degrees:
        levels = ", ".join(f"{name}: {value:.3f}" for name, value in search.degrees.items())
        CONSOLE.log(f"SH degree {search.degree} (PSNR by degree after the same training: {levels} dB)")
    return True


def lower_degree(searched: SearchedField, degree: int) -> None:
    """Drop the coefficients above ``degree``; their mean over the views moves into the constant colour."""
    field = searched.field
    dc, rest = field["features_dc"], field["features_rest"]
    mean, _ = searched.mean_basis(field.sh_degree)
    dc.data.copy_(fold_harmonics(dc.data, rest.data, mean, degree)[0])
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
    folded, _ = fold_harmonics(dc.data, rest.data, mean, 0)

    def flattened(count: int) -> tuple[Tensor, Tensor, Tensor]:
        flat = torch.zeros(len(order), dtype=torch.bool, device=rest.device)
        flat[order[:count]] = True
        return flat, torch.where(flat[:, None], folded, dc.data), rest.data * ~flat[:, None, None]

    low, high = 0, len(order)
    for _ in range(BISECTIONS):
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
