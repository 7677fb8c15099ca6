"""The CUDA backend: gsplat 1.4 and 1.5 behind one interface. gsplat is imported only inside these functions."""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.rasterization.constants import constant
from sundae_ns.rasterization.reference import ReferenceBackend, largest_axis
from sundae_ns.rasterization.types import Rasterization

_CHANNELS_PER_PASS = 32


class GsplatBackend:
    """The kernels of gsplat; float32 tensors on a CUDA device."""

    name = "gsplat"

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
            BackendError: The tensors are not float32 on a CUDA device.
        """
        from gsplat import rasterization

        _check_kernels_take(means)
        if means.shape[0] == 0:  # CUDA refuses to launch a grid of no blocks
            return ReferenceBackend().rasterize(
                means,
                quats,
                scales,
                opacities,
                colors,
                viewmat,
                K,
                width,
                height,
                near_plane=near_plane,
                far_plane=far_plane,
                antialiased=antialiased,
                absgrad=absgrad,
                render_depth=render_depth,
            )
        channels = colors.shape[1]
        rendered, alpha, info = rasterization(
            means,
            _without_zeros(quats),
            scales,
            opacities,
            colors,
            viewmat[None],
            K[None],
            width,
            height,
            near_plane=near_plane,
            far_plane=far_plane,
            sh_degree=None,
            packed=False,
            render_mode="RGB+ED" if render_depth else "RGB",
            absgrad=absgrad,
            rasterize_mode="antialiased" if antialiased else "classic",
            # Each pass overwrites absgrad with that of its own channels, so with absgrad there must be one pass only.
            channel_chunk=max(_CHANNELS_PER_PASS, channels + 1) if absgrad else _CHANNELS_PER_PASS,
        )
        return Rasterization(
            colors=rendered[0, ..., :channels],
            depth=rendered[0, ..., channels:] if render_depth else None,
            alpha=alpha[0],
            radii=largest_axis(info["radii"][0]),
            info=info,
        )

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        """Sum of harmonics ``[N, 3]`` for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``.

        Raises:
            BackendError: The tensors are not float32 on a CUDA device.
        """
        from gsplat import spherical_harmonics

        _check_kernels_take(directions)
        if directions.shape[0] == 0:
            return ReferenceBackend().spherical_harmonics(degree, directions, coeffs)
        return spherical_harmonics(degree, directions, coeffs)


def _check_kernels_take(tensor: Tensor) -> None:
    if tensor.dtype != torch.float32 or tensor.device.type != "cuda":
        raise BackendError(
            f"gsplat takes float32 on cuda, not {tensor.dtype} on {tensor.device}; convert, or use 'reference'"
        )


def _without_zeros(quats: Tensor) -> Tensor:
    """Replace all-zero quaternions by the identity; the kernels would divide by their length."""
    is_zero = (quats == 0).all(dim=-1, keepdim=True)
    return torch.where(is_zero, constant((1.0, 0.0, 0.0, 0.0), quats.dtype, quats.device), quats)
