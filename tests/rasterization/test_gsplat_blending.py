"""Blending with gradients under gsplat: the CUDA source, compiled for the CPU, against the reference in float64."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from sundae_ns.errors import SundaeError
from sundae_ns.rasterization import gsplat_kernels
from sundae_ns.rasterization.gsplat_kernels import TILE, GsplatLists, blend
from sundae_ns.rasterization.reference import Projection, composite

NAMES = ("means2d", "conics", "colors", "opacities")


@pytest.fixture(autouse=True)
def on_cpu(load_on_cpu: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsplat_kernels, "load_kernels", load_on_cpu)
    monkeypatch.setattr(gsplat_kernels, "LANES", 1)


def field(n: int, channels: int, width: int, height: int, *, opacity: float = 1.0) -> dict[str, Tensor]:
    """Ellipses in and around an image, float64; some are opaque, and some are too faint to be blended."""
    angle, sides = torch.rand(n) * 3.2, 10 ** (torch.rand(2, n) * 2.5 - 0.5)
    c, s = angle.cos(), angle.sin()
    xx, yy = sides[0] * c * c + sides[1] * s * s + 0.3, sides[0] * s * s + sides[1] * c * c + 0.3
    xy = (sides[0] - sides[1]) * c * s
    covariances = torch.stack([xx, xy, yy], dim=1).double()
    det = covariances[:, 0] * covariances[:, 2] - covariances[:, 1] ** 2
    opacities = (torch.rand(n).double() * 1.3).clamp(max=1) * opacity
    opacities[::13] = 1e-3
    return {
        "covariances": covariances,
        "depths": torch.rand(n).double() + 0.1,
        "means2d": (torch.rand(1, n, 2).double() * 1.4 - 0.2) * torch.tensor([width, height]),
        "conics": (covariances[:, [2, 1, 0]] * torch.tensor([1, -1, 1]) / det[:, None])[None],
        "colors": torch.rand(1, n, channels).double(),
        "opacities": opacities[None],
    }


def whole_lists(primitives: dict[str, Tensor], width: int, height: int, spare: int) -> GsplatLists:
    """Every primitive in every tile, by depth, and a tile below the image with ``spare`` pairs."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    order = primitives["depths"].argsort(stable=True).int()
    starts = torch.arange(columns * (rows + (spare > 0)), dtype=torch.int32).clamp(max=columns * rows) * len(order)
    pairs = torch.cat([order.repeat(columns * rows), torch.zeros(spare, dtype=torch.int32)])
    return GsplatLists(width, height, starts.view(1, -1, columns), pairs)


def expected(
    primitives: dict[str, Tensor], leaves: dict[str, Tensor], width: int, height: int, absgrad: bool
) -> tuple[Tensor, Tensor]:
    radii = (3 * primitives["covariances"][:, [0, 2]].amax(1).sqrt()).ceil() + 1000  # no squares: every tile
    projection = Projection(
        means2d=primitives["means2d"][0],
        covars2d=primitives["covariances"],
        conics=leaves["conics"][0],
        depths=primitives["depths"],
        compensations=torch.ones_like(primitives["depths"]),
        radii=radii.int(),
    )
    opacities = leaves["opacities"][0]
    return composite(leaves["means2d"], projection, opacities, leaves["colors"][0], width, height, absgrad=absgrad)


def leaves_of(primitives: dict[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    return {name: primitives[name].to(dtype, copy=True).requires_grad_() for name in NAMES}


@pytest.mark.parametrize(
    ("n", "channels", "width", "height", "absgrad"),
    [
        (60, 3, 40, 23, False),
        (60, 3, 16, 16, True),
        (400, 16, 33, 17, False),  # more than a batch, and pixels that are finished early
        (20, 35, 20, 20, True),
        (1, 1, 1, 1, False),
    ],
)
@pytest.mark.parametrize("opacity", [0.3, 1.0], ids=["faint", "opaque"])
def test_image_and_gradients_match_the_reference(
    n: int, channels: int, width: int, height: int, absgrad: bool, opacity: float
) -> None:
    primitives = field(n, channels, width, height, opacity=opacity)
    ours, exact = leaves_of(primitives, torch.float32), leaves_of(primitives, torch.float64)
    lists = whole_lists(primitives, width, height, spare=7 if absgrad else 0)
    image, alpha = blend(*ours.values(), lists, absgrad)
    other_image, other_alpha = expected(primitives, exact, width, height, absgrad)
    assert image.shape == (1, height, width, channels)
    torch.testing.assert_close(image[0].double(), other_image, rtol=0, atol=2e-5)
    torch.testing.assert_close(alpha[0].double(), other_alpha, rtol=0, atol=2e-5)
    weights = torch.randn(height, width, channels + 1, dtype=torch.float64)
    for images, alphas in ((image[0], alpha[0]), (other_image, other_alpha)):
        (torch.cat([images, alphas], dim=-1) * weights).sum().backward()
    pairs = [(ours[name].grad, exact[name].grad) for name in NAMES]
    if absgrad:
        pairs.append((ours["means2d"].absgrad, exact["means2d"].absgrad))  # type: ignore[attr-defined]
    for found, truth in pairs:
        assert found is not None
        assert truth is not None
        assert (found - truth).norm() <= 1e-4 * truth.norm() + 1e-6


def test_gradients_flow_into_some_inputs_only() -> None:
    primitives = field(30, 3, 20, 20)
    ours = {name: primitives[name].float() for name in NAMES}
    ours["colors"].requires_grad_()
    lists = whole_lists(primitives, 20, 20, spare=0)
    image, _ = blend(*ours.values(), lists, False)
    (gradient,) = torch.autograd.grad(image.sum(), ours["colors"])
    assert (gradient >= 0).all()
    assert gradient.sum() > 0


def test_an_empty_list_leaves_the_background() -> None:
    ours = leaves_of(field(5, 3, 20, 20), torch.float32)
    lists = GsplatLists(20, 20, torch.zeros(1, 2, 2, dtype=torch.int32), torch.zeros(0, dtype=torch.int32))
    image, alpha = blend(*ours.values(), lists, False)
    assert not image.any()
    assert not alpha.any()
    (image.sum() + alpha.sum()).backward()
    assert all(not leaf.grad.any() for leaf in ours.values() if leaf.grad is not None)


def test_second_derivatives_are_refused() -> None:
    primitives = field(5, 3, 20, 20)
    ours = leaves_of(primitives, torch.float32)
    image, _ = blend(*ours.values(), whole_lists(primitives, 20, 20, spare=0), False)
    with pytest.raises(SundaeError, match="second derivative"):
        torch.autograd.grad(image.sum(), ours["means2d"], create_graph=True)


def test_kernels_compile_for_gpus(compile_for_gpu: Callable[..., bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gsplat_kernels, "LANES", 32)
    for architecture, channels, absgrad in (("sm_75", 3, True), ("sm_90", 16, False), ("sm_90", 32, False)):
        options = gsplat_kernels.blending_options(channels, absgrad=absgrad)
        compile_for_gpu("blending.cu", architecture, options)
