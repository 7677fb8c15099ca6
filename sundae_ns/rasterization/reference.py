"""The reference backend: pure torch, any device, float32 or float64, independent of gsplat."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch
from torch import Tensor

from sundae_ns.rasterization.compositing import composite
from sundae_ns.rasterization.harmonics import evaluate_harmonics
from sundae_ns.rasterization.projection import project
from sundae_ns.rasterization.tiles import build_tile_lists
from sundae_ns.rasterization.types import Rasterization

_SMALLEST_ALPHA = 1e-10  # divides depths; any alpha that was blended is larger


class ReferenceBackend:
    """Autograd projection and tiled blending, with the thresholds of gsplat 1.4's CUDA kernels."""

    name = "reference"

    def rasterize(
        self,
        means: Tensor,  # [N, 3]
        quats: Tensor,  # [N, 4]
        scales: Tensor,  # [N, 3]
        opacities: Tensor,  # [N]
        colors: Tensor,  # [N, C]
        viewmat: Tensor,  # [4, 4]
        K: Tensor,  # [3, 3]
        width: int,
        height: int,
        *,
        near_plane: float,
        far_plane: float,
        antialiased: bool,
        absgrad: bool,
        render_depth: bool,
    ) -> Rasterization:
        """Render one view; see :func:`sundae_ns.rasterization.rasterize`."""
        projection = project(means, quats, scales, viewmat, K, width, height, near_plane, far_plane)
        if antialiased:
            opacities = opacities * projection.compensations
        channels = colors.shape[1]
        if render_depth:
            colors = torch.cat([colors, projection.depths[:, None]], dim=-1)
        means2d = projection.means2d[None]
        lists = build_tile_lists(projection, opacities, width, height)
        image, alpha = composite(means2d, projection.conics, opacities, colors, lists, width, height, absgrad)
        return assemble(image, alpha, means2d, projection.radii, channels)

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        """Sum of harmonics ``[N, 3]`` for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``."""
        return evaluate_harmonics(degree, directions, coeffs)


def assemble(image: Tensor, alpha: Tensor, means2d: Tensor, radii: Tensor, channels: int) -> Rasterization:
    """The result of a view from its blended image ``[H, W, C]`` or, with depth behind the channels, ``[H, W, C + 1]``.

    Args:
        image: Channels, then perhaps depth. ``[H, W, C]`` or ``[H, W, C + 1]``
        alpha: Accumulated opacity. ``[H, W, 1]``
        means2d: Centres in pixels. ``[1, N, 2]``
        radii: int32 ``[N]``
        channels: C.
    """
    height, width, depth = image.shape
    return Rasterization(
        colors=image[..., :channels] if depth > channels else image,
        depth=image[..., channels:] / alpha.clamp(min=_SMALLEST_ALPHA) if depth > channels else None,
        alpha=alpha,
        radii=radii,
        info=_strategy_info(means2d, radii, width, height),
    )


def per_axis(radii: Tensor) -> Tensor:
    """Radii ``[N]`` in the shape that strategies of the installed gsplat expect: ``[N]`` in 1.4, ``[N, 2]`` from 1.5."""
    return radii[:, None].expand(-1, 2) if _radii_per_axis() else radii


def largest_axis(radii: Tensor) -> Tensor:
    """Radii as any installed gsplat gives them, ``[N]`` or ``[N, 2]``, as one a primitive ``[N]``."""
    return radii if radii.dim() == 1 else radii.amax(dim=-1)


def _strategy_info(means2d: Tensor, radii: Tensor, width: int, height: int) -> dict[str, Any]:
    return {
        "means2d": means2d,
        "radii": per_axis(radii)[None],
        "width": width,
        "height": height,
        "n_cameras": 1,
        "gaussian_ids": None,
    }


@lru_cache(maxsize=1)
def _radii_per_axis() -> bool:
    """Whether the installed gsplat's strategies expect radii ``[1, N, 2]``, as from 1.5; those of 1.4 want ``[1, N]``."""
    try:
        major, minor = version("gsplat").split(".")[:2]
    except PackageNotFoundError:
        return False
    return (int(major), int(minor)) >= (1, 5)
