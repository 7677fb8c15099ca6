"""The shadow of an ellipsoid, against known bodies and against sampled directions."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sundae_ns.pruning import footprint


def field(axes: list[list[float]], opacity: float = 0.5) -> dict[str, Tensor]:
    logit = math.log(opacity / (1 - opacity))
    return {"scales": torch.tensor(axes).double().log(), "opacities": torch.full((len(axes), 1), logit).double()}


def test_a_ball_and_a_disc() -> None:
    found = footprint(field([[2.0, 2.0, 2.0], [3.0, 3.0, 1e-9]], opacity=0.25))
    assert found[0].item() == pytest.approx(0.25 * math.pi * 4)
    assert found[1].item() == pytest.approx(0.25 * math.pi * 9 / 2, rel=0.011)


def test_the_mean_shadow_of_an_ellipsoid() -> None:
    axes = torch.tensor([1.0, 0.3, 0.05]).double()
    directions = torch.nn.functional.normalize(
        torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    # The shadow of x/a + y/b + z/c = 1 along a unit vector d has the area pi abc |d / (a, b, c)|.
    shadows = math.pi * axes.prod() * (directions.double() / axes).norm(dim=1)
    assert footprint(field([axes.tolist()])).item() == pytest.approx(0.5 * shadows.mean().item(), rel=0.012)


def test_footprint_depends_on_size_and_not_on_the_order_of_axes() -> None:
    a, b, c = footprint(field([[1.0, 2.0, 3.0], [3.0, 1.0, 2.0], [10.0, 20.0, 30.0]]))
    assert a.item() == pytest.approx(b.item())
    assert c.item() == pytest.approx(100 * a.item())


def test_extreme_sizes_stay_finite() -> None:
    huge = {
        "scales": torch.tensor([[1e30, 0.0, -1e30]]).repeat(3, 1),
        "opacities": torch.tensor([[-1e30], [0.0], [1e30]]),
    }
    assert torch.isfinite(footprint(huge)).all()
