"""Arguments of the rasterisers by keyword."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.rasterize import interface
from sundae_ns.rasterize.types import Backend, Inputs, Rasterization


def inputs_of(*, viewmat: Tensor, K: Tensor, width: int, height: int, **values: Any) -> Inputs:
    """Inputs with a camera of these values; opacities and colours are 1 by default."""
    ones = values["means"].new_ones(len(values["means"]), 1)
    return Inputs(camera=Camera(viewmat, K, width, height, 1.0), **{"opacities": ones[:, 0], "colors": ones, **values})


def geometry(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int
) -> Inputs:
    """Inputs of a projection."""
    return inputs_of(means=means, quats=quats, scales=scales, viewmat=viewmat, K=K, width=width, height=height)


def rasterize(*, backend: Backend, **values: Any) -> Rasterization:
    return interface.rasterize(inputs_of(**values), backend=backend)


def rasterize_cameras(*, viewmats: Tensor, Ks: Tensor, backend: Backend, **values: Any) -> Tensor:
    inputs = inputs_of(viewmat=torch.eye(4), K=torch.eye(3), **values)
    return interface.rasterize_cameras(inputs, viewmats, Ks, backend=backend)


def blending_weights(*, backend: Backend, pixels: Tensor | None = None, **values: Any) -> Tensor:
    return interface.blending_weights(inputs_of(**values), pixels, backend=backend)


def several_views(n: int = 50, channels: int = 4) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Gaussians, and three views of them: colours, transforms and intrinsics as ``rasterize_cameras`` takes them."""
    generator = torch.Generator().manual_seed(0)
    shared = {
        "means": torch.rand(n, 3, generator=generator) - 0.5,
        "quats": torch.randn(n, 4, generator=generator),
        "scales": 0.01 + 0.1 * torch.rand(n, 3, generator=generator),
        "opacities": 0.3 * torch.rand(n, generator=generator),
    }
    viewmats = torch.eye(4).repeat(3, 1, 1)
    viewmats[:, :3, 3] = torch.tensor([[0.0, 0.0, 2.0], [0.3, -0.2, 1.5], [0.0, 0.1, 0.4]])
    Ks = torch.tensor([[30.0, 0, 20.0], [0, 28.0, 15.0], [0, 0, 1]]).repeat(3, 1, 1)
    Ks[1, :2] *= 1.5
    return shared, {"colors": torch.rand(3, n, channels, generator=generator), "viewmats": viewmats, "Ks": Ks}
