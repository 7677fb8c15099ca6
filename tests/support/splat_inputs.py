"""Arguments of the rasterisers' stages."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sundae_ns.rasterize.types import Inputs


def geometry(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, **more: Any
) -> Inputs:
    """Inputs of a projection; their opacities and colours are 1."""
    ones = means.new_ones(len(means), 1)
    defaults = {"near_plane": 0.01, "far_plane": 1e10, "antialiased": False, "absgrad": False, "render_depth": False}
    return Inputs(means, quats, scales, ones[:, 0], ones, viewmat, K, width, height, **{**defaults, **more})


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
