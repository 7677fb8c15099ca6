"""Arguments of the rasterisers' stages."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from sundae_ns.rasterization.types import Inputs


def geometry(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, **more: Any
) -> Inputs:
    """Inputs of a projection; their opacities and colours are 1."""
    ones = means.new_ones(len(means), 1)
    defaults = {"near_plane": 0.01, "far_plane": 1e10, "antialiased": False, "absgrad": False, "render_depth": False}
    return Inputs(means, quats, scales, ones[:, 0], ones, viewmat, K, width, height, **{**defaults, **more})
