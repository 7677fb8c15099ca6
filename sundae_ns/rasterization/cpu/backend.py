"""The backend itself: projection, lists and blending of one view, and the strategy's information."""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.rasterization.cpu.compositing import composite
from sundae_ns.rasterization.cpu.projection import project
from sundae_ns.rasterization.cpu.tiles import build_lists
from sundae_ns.rasterization.harmonics import evaluate_harmonics
from sundae_ns.rasterization.reference import assemble
from sundae_ns.rasterization.types import Rasterization


class CpuBackend:
    """Compiled loops on the CPU, float32 or float64: what the reference computes, bit for bit the same on any threads."""

    name = "cpu"

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
        """Render one view; see :func:`sundae_ns.rasterization.rasterize`.

        Raises:
            BackendError: The tensors are not float32 or float64 on a CPU.
        """
        if means.dtype not in (torch.float32, torch.float64) or means.device.type != "cpu":
            raise BackendError(
                f"the cpu rasterizer takes float32 or float64 on a CPU, not {means.dtype} on {means.device}; "
                "convert, or use 'reference'"
            )
        projection = project(means, quats, scales, viewmat, K, width, height, near_plane, far_plane)
        if antialiased:
            opacities = opacities * projection.compensations
        channels = colors.shape[1]
        if render_depth:
            colors = torch.cat([colors, projection.depths[:, None]], dim=-1)
        means2d = projection.means2d[None]
        lists = build_lists(projection, opacities, width, height)
        image, alpha = composite(means2d, projection.conics, opacities, colors, lists, width, height, absgrad)
        return assemble(image, alpha, means2d, projection.radii, channels)

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        """Sum of harmonics ``[N, 3]`` for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``."""
        return evaluate_harmonics(degree, directions, coeffs)
