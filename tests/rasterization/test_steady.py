"""Rasterisers on hard scenes: values and gradients are finite, and the reference in float32 is close to float64.

Scenes are given before activation, as in training, and rounded to float32 before they are rendered in float64, so
differences come from arithmetic alone. Errors are the norm of the difference over the norm in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from sundae_ns.rasterization import Backend, Rasterization, rasterize, select_backend

REFERENCE = select_backend("reference", "cpu")
NEAR = 2.0**-6
"""A float32 number, so that a primitive can lie on the plane in both precisions."""
FLOOR = 1e-6
"""Lower bound of norms that divide errors: a gradient that vanishes in float64 has no relative error."""
Scene = dict[str, Tensor]


def scene(n: int = 300, seed: int = 0) -> Scene:
    generator = torch.Generator().manual_seed(seed)
    return {
        "means": (torch.rand(n, 3, generator=generator) - 0.5) * 2 + torch.tensor([0.0, 0.0, 3.0]),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.log(0.02 + 0.1 * torch.rand(n, 3, generator=generator)),
        "opacities": torch.randn(n, generator=generator),
        "colors": torch.rand(n, 3, generator=generator),
    }


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


def with_scales(value: float) -> Scene:
    made = scene()
    made["scales"][:150] = math.log(value)
    return made


def needles() -> Scene:
    """One axis a hundred billion times as long as the others."""
    made = scene()
    made["scales"][:150] = torch.log(torch.tensor([1e3, 1e-8, 1e-8]))
    return made


def with_opacities(logit: float) -> Scene:
    made = scene()
    made["opacities"][:150] = logit
    return made


def around_the_near_plane() -> Scene:
    """Primitives on the plane, one step of float32 before and behind it, on the camera, and behind it."""
    made = scene()
    near = torch.tensor(NEAR)
    steps = [near, near.nextafter(torch.tensor(1.0)), near.nextafter(torch.tensor(0.0)), 0 * near, -near, -near * 100]
    for i, z in enumerate(steps):
        made["means"][10 * i : 10 * i + 10, 2] = z
        made["means"][10 * i : 10 * i + 5, :2] = 0.0
    return made


def without_rotations() -> Scene:
    made = scene()
    made["quats"][:150] = 0.0
    return made


def on_one_pixel() -> Scene:
    made = scene(10_000)
    made["means"][:, :2] *= 1e-3
    made["scales"] -= 1.0
    return made


def opaque_on_one_pixel() -> Scene:
    made = on_one_pixel()
    made["opacities"][:] = 30.0
    return made


def behind_the_camera() -> Scene:
    made = scene()
    made["means"][:, 2] -= 10.0
    return made


# Scene, image size, and the bounds on the errors of the image and of the worst gradient. Measured worst cases: 9.9e-7
# and 9.3e-6, except where noted.
CASES: dict[str, tuple[Callable[[], Scene], int, float, float]] = {
    "ordinary": (scene, 48, 5e-6, 2e-5),
    "scales of 1e-8": (lambda: with_scales(1e-8), 48, 5e-6, 2e-5),
    "scales of 1e3": (lambda: with_scales(1e3), 48, 5e-6, 2e-5),
    "needles of 1e3 and 1e-8": (needles, 48, 5e-5, 1e-3),  # measured 6.5e-6 and 1.6e-4
    "logits of 30": (lambda: with_opacities(30.0), 48, 5e-6, 2e-5),
    "logits of -30": (lambda: with_opacities(-30.0), 48, 5e-6, 2e-5),
    "on and behind the near plane": (around_the_near_plane, 48, 5e-6, 2e-5),
    "all behind the camera": (behind_the_camera, 48, 0.0, 0.0),
    "quaternions of zeros": (without_rotations, 48, 5e-6, 2e-5),
    "an image of one pixel": (scene, 1, 5e-6, 1e-4),  # measured 9.9e-7 and 2.0e-5
    "10,000 on one pixel": (on_one_pixel, 16, 5e-6, 2e-5),
    "10,000 opaque on one pixel": (opaque_on_one_pixel, 16, 5e-6, 2e-5),
}


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
