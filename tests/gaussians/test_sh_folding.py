"""Folding of spherical harmonics into a lower SH degree."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sundae_ns.gaussians.parameters import SH_C0
from sundae_ns.gaussians.sh_folding import fold_harmonics, mean_basis, view_dependence
from sundae_ns.rasterization.harmonics import evaluate_harmonics, harmonic_basis

N, VIEWS, DEGREE = 12, 40, 3


def directions() -> Tensor:
    """Directions from one side, as most primitives are seen ``[VIEWS, N, 3]``."""
    generator = torch.Generator().manual_seed(3)
    return normalize(torch.randn(VIEWS, N, 3, generator=generator) * 0.4 + torch.tensor([0.0, 0.0, 1.0]), dim=-1)


def views(weights: Tensor) -> list[tuple[Tensor, Tensor]]:
    return [(weight, harmonic_basis(DEGREE, seen)) for weight, seen in zip(weights, directions())]


def colours(dc: Tensor, rest: Tensor) -> Tensor:
    """Colours of the primitives in each view ``[VIEWS, N, 3]``."""
    coeffs = torch.cat([dc[:, None], rest], dim=1)
    degree = round(coeffs.shape[1] ** 0.5) - 1
    return torch.stack([evaluate_harmonics(degree, seen, coeffs) for seen in directions()])


def test_the_folded_colour_is_the_nearest_constant() -> None:
    weights, dc, rest = torch.rand(VIEWS, N), torch.randn(N, 3), torch.randn(N, 15, 3)
    mean, _ = mean_basis(views(weights))
    folded, none = fold_harmonics(dc, rest, mean, 0)
    assert none.shape == (N, 0, 3)
    expected = (weights[..., None] * colours(dc, rest)).sum(dim=0) / weights.sum(dim=0)[:, None]
    torch.testing.assert_close(folded * SH_C0, expected)


def test_mean_colour_is_kept_at_every_degree() -> None:
    weights, dc, rest = torch.ones(VIEWS, N), torch.randn(N, 3), torch.randn(N, 15, 3)
    mean, _ = mean_basis(views(weights))
    for degree, columns in ((0, 0), (1, 3), (2, 8), (3, 15)):
        folded, kept = fold_harmonics(dc, rest, mean, degree)
        assert kept.shape == (N, columns, 3)
        torch.testing.assert_close(colours(folded, kept).mean(dim=0), colours(dc, rest).mean(dim=0))


def test_unseen_primitives_keep_degree_0() -> None:
    weights = torch.rand(VIEWS, N)
    weights[:, 4] = 0
    dc, rest = torch.randn(N, 3), torch.randn(N, 15, 3)
    mean, square = mean_basis(views(weights))
    assert torch.equal(fold_harmonics(dc, rest, mean, 0)[0][4], dc[4])
    assert view_dependence(rest, mean, square, weights.sum(dim=0))[4] == 0


def test_view_dependence_is_the_weighted_variance_of_the_colour() -> None:
    weights, rest = torch.ones(VIEWS, N), torch.zeros(N, 15, 3)
    rest[1, 2], rest[2, 2] = 0.5, 2.0
    mean, square = mean_basis(views(weights))
    found = view_dependence(rest, mean, square, weights.sum(dim=0))
    assert found[0] == 0
    assert 0 < found[1] < found[2]
    # One coefficient alone has no cross terms: the variance of the colours times the weight.
    expected = VIEWS * colours(torch.zeros(N, 3), rest)[:, 2].var(dim=0, unbiased=False).sum()
    torch.testing.assert_close(found[2], expected, rtol=1e-4, atol=1e-5)
