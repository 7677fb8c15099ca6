"""Updates of 3DGS-MCMC: copies render like their original, and counts are exact."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from sundae_ns.gaussians.surgery import MAX_COPIES, draw_sources, grow, split_evenly

FIELD = {"means": (3,), "scales": (3,), "quats": (4,), "features_dc": (3,), "opacities": (1,)}


def field(n: int = 30) -> tuple[dict[str, Parameter], dict[str, Adam]]:
    params = {name: Parameter(torch.randn(n, *shape)) for name, shape in FIELD.items()}
    optimizers = {name: Adam([value], lr=0.01) for name, value in params.items()}
    torch.stack([value.square().sum() for value in params.values()]).sum().backward()
    for optimizer in optimizers.values():
        optimizer.step()
    return params, optimizers


def integral(opacity: float, scale: float, copies: int) -> float:
    """Integral along a line of the opacity of ``copies`` primitives at one place, by the midpoint rule."""
    x = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 20_000 * 24 - 12
    alpha = opacity * torch.exp(-0.5 * (x / scale) ** 2)
    return float((1 - (1 - alpha) ** copies).sum() * 24 / 20_000)


@given(st.floats(0.006, 0.995), st.integers(1, MAX_COPIES))
def test_copies_are_as_opaque_as_the_original(opacity: float, copies: int) -> None:
    new, scales = split_evenly(
        torch.tensor([opacity], dtype=torch.float64), torch.ones(1, 3, dtype=torch.float64), torch.tensor([copies])
    )
    assert 1 - (1 - float(new)) ** copies == pytest.approx(opacity, rel=1e-9)
    assert integral(float(new), float(scales[0, 0]), copies) == pytest.approx(integral(opacity, 1.0, 1), rel=1e-6)


def test_one_copy_is_the_original_and_float32_stays_finite() -> None:
    opacities, scales = torch.rand(50).clamp(0.01, 0.99), torch.rand(50, 3) + 0.1
    same, size = split_evenly(opacities, scales, torch.ones(50, dtype=torch.long))
    torch.testing.assert_close(same, opacities)
    torch.testing.assert_close(size, scales)
    many = split_evenly(opacities, scales, torch.full((50,), 10**6))
    assert many[0].dtype == many[1].dtype == torch.float32
    assert all(torch.isfinite(value).all() and (value > 0).all() for value in many)


@pytest.mark.gpu
def test_split_evenly_agrees_with_gsplat() -> None:
    from gsplat.relocation import compute_relocation

    opacities, scales = torch.rand(500).clamp(0.01, 0.99).cuda(), torch.rand(500, 3).cuda() + 0.1
    copies = torch.randint(1, 20, (500,)).cuda()
    binoms = torch.tensor([[float(math.comb(n, k)) for k in range(51)] for n in range(51)]).cuda()
    expected = compute_relocation(opacities, scales, copies.clone(), binoms)
    for found, wanted in zip(split_evenly(opacities, scales, copies), expected):
        torch.testing.assert_close(found, wanted, rtol=2e-3, atol=1e-5)


def test_draws_follow_the_weights() -> None:
    weights = torch.tensor([0.0, 1.0, 3.0, 0.0])
    found = torch.bincount(draw_sources(weights, 40_000), minlength=4)
    assert found[0] == found[3] == 0
    assert 0.23 < found[1] / 40_000 < 0.27


def moments(optimizers: dict[str, Adam], params: dict[str, Parameter], name: str) -> Tensor:
    return optimizers[name].state[params[name]]["exp_avg"]


def test_growing_adds_the_exact_number() -> None:
    params, optimizers = field()
    old = {name: value.detach().clone() for name, value in params.items()}
    kept = moments(optimizers, params, "quats").clone()
    grow(params, optimizers, 7, 0.005)
    assert {len(value) for value in params.values()} == {37}
    for name, value in params.items():
        assert optimizers[name].param_groups[0]["params"] == [value]
        assert moments(optimizers, params, name).shape == value.shape
    assert torch.equal(params["means"][:30], old["means"])
    assert torch.equal(moments(optimizers, params, "quats")[:30], kept)
    assert not moments(optimizers, params, "quats")[30:].any()
    grow(params, optimizers, 0, 0.005)
    assert len(params["means"]) == 37
