"""The CUDA backend: gsplat 1.4 and 1.5 behind one interface. gsplat is imported only inside functions."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from sundae_ns.core.errors import BackendError
from sundae_ns.rasterize import gsplat_kernels
from sundae_ns.rasterize.gsplat_kernels import TILE, Capacity, GsplatLists, Splats
from sundae_ns.rasterize.reference import ReferenceBackend
from sundae_ns.rasterize.types import Inputs, Rasterization, constant, is_gsplat_1_5, result_of

_CHANNELS_PER_PASS = 32


class GsplatBackend:
    """gsplat's kernels, for float32 tensors on a CUDA device."""

    name = "gsplat"

    def rasterize(self, inputs: Inputs) -> Rasterization:
        """Render one view.

        Raises:
            BackendError: The tensors are not float32 on a CUDA device.
        """
        _check_kernels_take(inputs.means)
        if inputs.means.shape[0] == 0:  # CUDA refuses to launch a grid of no blocks
            return ReferenceBackend().rasterize(inputs)
        camera = inputs.camera
        splats = _project(inputs, camera.viewmat[None], camera.K[None])
        lists = self._lists(splats, camera.width, camera.height)
        channels = inputs.colors
        if inputs.render_depth:
            channels = torch.cat([channels, splats.depths[0, :, None]], dim=1)
        # Each pass overwrites absgrad with that of its own channels, so absgrad allows one pass only.
        passes = [channels] if inputs.absgrad else channels.split(_CHANNELS_PER_PASS, dim=1)
        blended = [self._blend(splats, part[None], lists, inputs.absgrad) for part in passes]
        image = blended[0][0][0] if len(blended) == 1 else torch.cat([part[0] for part, _ in blended], dim=-1)
        return result_of(image, blended[0][1][0], splats.means2d, splats.radii, inputs)

    def rasterize_cameras(self, inputs: Inputs, viewmats: Tensor, Ks: Tensor) -> Tensor:
        """Render several cameras at once, with one wait for the device; colours are ``[V, N, C]``.

        Raises:
            BackendError: The tensors are not float32 on a CUDA device.
        """
        _check_kernels_take(inputs.means)
        splats = _project(inputs, viewmats, Ks)
        lists = GsplatBackend._lists(self, splats, inputs.camera.width, inputs.camera.height)
        parts = inputs.colors.split(_CHANNELS_PER_PASS, dim=2)
        return torch.cat([GsplatBackend._blend(self, splats, part, lists, False)[0] for part in parts], dim=-1)

    def _lists(self, splats: Splats, width: int, height: int) -> GsplatLists:
        """gsplat's own lists: every tile that a Gaussian's bounding square touches."""
        from gsplat import isect_offset_encode, isect_tiles

        columns, rows = -(-width // TILE), -(-height // TILE)
        _, pairs, ids = isect_tiles(splats.means2d, splats.radii, splats.depths, TILE, columns, rows)
        starts = isect_offset_encode(pairs, len(splats.means2d), columns, rows)
        return GsplatLists(width, height, starts, ids)

    def _blend(self, splats: Splats, colors: Tensor, lists: GsplatLists, absgrad: bool) -> tuple[Tensor, Tensor]:
        """Images ``[V, H, W, C]`` and alphas ``[V, H, W, 1]`` of colours ``[V, N, C]``."""
        from gsplat import rasterize_to_pixels

        return rasterize_to_pixels(
            *(splats.means2d, splats.conics, colors, splats.opacities, lists.width, lists.height, TILE),
            *(lists.starts, lists.primitives),
            masks=lists.drawn,
            absgrad=absgrad,
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


class RecordableGsplat(GsplatBackend):
    """gsplat that CUDA graphs can record: nothing waits for the GPU, and all work is on torch's current stream.

    Tiles get our own lists, shorter than gsplat's. Colours, and blending with gradients, have kernels of our own.

    Args:
        capacity: for tile/Gaussian pairs.
    """

    def __init__(self, capacity: Capacity) -> None:
        self._capacity = capacity

    def _lists(self, splats: Splats, width: int, height: int) -> GsplatLists:
        return gsplat_kernels.tile_lists(splats, width, height, capacity=self._capacity)

    def _blend(self, splats: Splats, colors: Tensor, lists: GsplatLists, absgrad: bool) -> tuple[Tensor, Tensor]:
        values = (splats.means2d, splats.conics, colors, splats.opacities)
        if torch.is_grad_enabled() and any(value.requires_grad for value in values):
            return gsplat_kernels.blend(*values, lists, absgrad)
        return super()._blend(splats, colors, lists, absgrad)  # frames stay gsplat's to the bit

    def harmonic_colors(
        self, degree: int, means: Tensor, center: Tensor, features_dc: Tensor, features_rest: Tensor
    ) -> Tensor:
        """See :func:`sundae_ns.rasterize.interface.harmonic_colors`; differentiable once, but not in ``center``.

        Raises:
            BackendError: The tensors are not float32 on a CUDA device, or the kernels cannot be compiled.
        """
        _check_kernels_take(means)
        return cast("Tensor", gsplat_kernels.harmonic_colors(degree, means, center, features_dc, features_rest))


def _project(inputs: Inputs, viewmats: Tensor, Ks: Tensor) -> Splats:
    """Project Gaussians to the screens of views, transforms ``[V, 4, 4]`` and intrinsics ``[V, 3, 3]``."""
    from gsplat import fully_fused_projection

    opacities = inputs.opacities
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        *(inputs.means, None, _without_zeros(inputs.quats), inputs.scales),
        *(viewmats, Ks, inputs.camera.width, inputs.camera.height),
        near_plane=inputs.near_plane,
        far_plane=inputs.far_plane,
        calc_compensations=inputs.antialiased,
        **({"opacities": opacities} if is_gsplat_1_5() else {}),
    )
    opacities = opacities.expand(len(viewmats), -1) if compensations is None else opacities * compensations
    return Splats(radii, means2d, depths, conics, opacities)


def _check_kernels_take(tensor: Tensor) -> None:
    if tensor.dtype != torch.float32 or tensor.device.type != "cuda":
        raise BackendError(
            f"gsplat takes float32 on cuda, not {tensor.dtype} on {tensor.device}; convert, or use 'reference'"
        )


def _without_zeros(quats: Tensor) -> Tensor:
    """Replace all-zero quaternions by the identity, because the kernels divide by the length."""
    is_zero = (quats == 0).all(dim=-1, keepdim=True)
    return torch.where(is_zero, constant((1.0, 0.0, 0.0, 0.0), quats.dtype, quats.device), quats)
