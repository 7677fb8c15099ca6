"""Rasterisers on hard scenes: values and gradients are finite, and the reference in float32 is close to float64.

Scenes are given before activation, as in training, and rounded to float32 before they are rendered in float64, so
differences come from arithmetic alone. Errors are the norm of the difference over the norm in float64.
"""

from __future__ import annotations

import pytest
import torch
from hard_scenes import CASES, NEAR, Scene
from torch import Tensor

from sundae_ns.rasterization import Backend, Rasterization, rasterize, select_backend

REFERENCE = select_backend("reference", "cpu")
FLOOR = 1e-6
"""Lower bound of norms that divide errors: a gradient that vanishes in float64 has no relative error."""


def render(
    made: Scene, dtype: torch.dtype, size: int, antialiased: bool, *, backend: Backend = REFERENCE, device: str = "cpu"
) -> tuple[Rasterization, Scene]:
    """The rendering, and the gradients of its sum with fixed random weights."""
    leaves = {name: value.to(device, dtype, copy=True).requires_grad_() for name, value in made.items()}
    K = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]], dtype=dtype, device=device)
    rendered = rasterize(
        leaves["means"],
        leaves["quats"],
        leaves["scales"].exp(),
        leaves["opacities"].sigmoid(),
        leaves["colors"],
        torch.eye(4, dtype=dtype, device=device),
        K,
        size,
        size,
        near_plane=NEAR,
        antialiased=antialiased,
        absgrad=True,
        render_depth=True,
        backend=backend,
    )
    assert rendered.depth is not None
    image = torch.cat([rendered.colors, rendered.alpha, rendered.depth], dim=2)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(9)).to(image)
    (image * weights).sum().backward()
    gradients = {name: leaf.grad if leaf.grad is not None else torch.zeros_like(leaf) for name, leaf in leaves.items()}
    return rendered, gradients


def difference(found: Tensor, exact: Tensor) -> float:
    found, exact = found.detach().double(), exact.detach()
    return float((found - exact).norm()) / max(float(exact.norm()), FLOOR)


@pytest.mark.parametrize("antialiased", [False, True], ids=["plain", "antialiased"])
@pytest.mark.parametrize("name", CASES)
def test_finite_and_close_to_float64(name: str, antialiased: bool) -> None:
    make, size, image_bound, gradient_bound = CASES[name]
    made = make()
    found, gradients = render(made, torch.float32, size, antialiased)
    exact, exact_gradients = render(made, torch.float64, size, antialiased)
    assert found.depth is not None
    assert exact.depth is not None
    for value in (found.colors, found.alpha, found.depth, *gradients.values()):
        assert value.isfinite().all()
    assert getattr(found.info["means2d"], "absgrad", torch.zeros(1)).isfinite().all()
    assert ((found.alpha >= 0) & (found.alpha <= 1)).all()
    image_error = max(difference(getattr(found, part), getattr(exact, part)) for part in ("colors", "alpha", "depth"))
    errors = {key: difference(gradients[key], exact_gradients[key]) for key in gradients}
    print(f"{name}: image {image_error:.1e}, gradients", {key: f"{value:.1e}" for key, value in errors.items()})
    assert image_error <= image_bound
    assert max(errors.values()) <= gradient_bound


@pytest.mark.gpu
@pytest.mark.parametrize("antialiased", [False, True], ids=["plain", "antialiased"])
@pytest.mark.parametrize("name", CASES)
def test_gsplat_is_finite(name: str, antialiased: bool) -> None:
    make, size, _, _ = CASES[name]
    gsplat = select_backend("gsplat", "cuda")
    found, gradients = render(make(), torch.float32, size, antialiased, backend=gsplat, device="cuda")
    assert found.depth is not None
    for value in (found.colors, found.alpha, found.depth, *gradients.values()):
        assert value.isfinite().all()
    assert ((found.alpha >= 0) & (found.alpha <= 1)).all()
