"""The CUDA backend: gsplat 1.4 and 1.5 behind one interface. gsplat is imported only inside functions."""

from __future__ import annotations

import torch
from torch import Tensor

from sundae_ns.core.errors import BackendError
from sundae_ns.rasterize import gsplat_kernels
from sundae_ns.rasterize.gsplat_kernels import TILE, Capacity, GsplatLists, Splats
from sundae_ns.rasterize.types import Inputs, Rasterization, constant, is_gsplat_1_5, result_of

_CHANNELS_PER_PASS = 32


class GsplatBackend:
    """gsplat's kernels, for one Gaussian at least, float32 on a CUDA device; ``BackendError`` for other tensors."""

    name = "gsplat"

    def rasterize(self, inputs: Inputs) -> Rasterization:
        """Render one view."""
        check_kernels_take(inputs.means)
        camera = inputs.camera
        images, alphas, splats = self._draw(inputs, camera.viewmat[None], camera.K[None], inputs.colors[None])
        return result_of(images[0], alphas[0], splats.means2d, splats.radii, inputs)

    def rasterize_cameras(self, inputs: Inputs, viewmats: Tensor, Ks: Tensor) -> Tensor:
        """Render several cameras at once, with one wait for the device; colours are ``[V, N, C]``."""
        check_kernels_take(inputs.means)
        return GsplatBackend()._draw(inputs, viewmats, Ks, inputs.colors)[0]  # our own lists are of one view

    def _draw(self, inputs: Inputs, viewmats: Tensor, Ks: Tensor, colors: Tensor) -> tuple[Tensor, Tensor, Splats]:
        """Images ``[V, H, W, C]`` and alphas ``[V, H, W, 1]`` of V views, and their splats; colours ``[V, N, C]``."""
        splats = _project(inputs, viewmats, Ks)
        lists = self._lists(splats, inputs.camera.width, inputs.camera.height)
        if inputs.render_depth:
            colors = torch.cat([colors, splats.depths[..., None]], dim=2)
        # Each pass overwrites absgrad with that of its own channels, so absgrad allows one pass only.
        passes = [colors] if inputs.absgrad else colors.split(_CHANNELS_PER_PASS, dim=2)
        images, alphas = zip(*(self._blend(splats, channels, lists, inputs.absgrad) for channels in passes))
        return images[0] if len(images) == 1 else torch.cat(images, dim=-1), alphas[0], splats

    def _lists(self, splats: Splats, width: int, height: int) -> GsplatLists:
        """gsplat's own lists: every tile that a Gaussian's bounding square touches."""
        from gsplat import isect_offset_encode, isect_tiles

        columns, rows = -(-width // TILE), -(-height // TILE)
        _, pairs, ids = isect_tiles(splats.means2d, splats.radii, splats.depths, TILE, columns, rows)
        return GsplatLists(width, height, isect_offset_encode(pairs, len(splats.means2d), columns, rows), ids)

    def _blend(self, splats: Splats, colors: Tensor, lists: GsplatLists, absgrad: bool) -> tuple[Tensor, Tensor]:
        """Images ``[V, H, W, C]`` and alphas ``[V, H, W, 1]`` of colours ``[V, N, C]``."""
        from gsplat import rasterize_to_pixels

        return rasterize_to_pixels(
            *(splats.means2d, splats.conics, colors, splats.opacities, lists.width, lists.height, TILE),
            *(lists.starts, lists.gaussians),
            masks=lists.drawn,
            absgrad=absgrad,
        )

    def spherical_harmonics(self, degree: int, directions: Tensor, first: Tensor, rest: Tensor) -> Tensor:
        """See :meth:`.Backend.spherical_harmonics`."""
        from gsplat import spherical_harmonics

        check_kernels_take(directions)
        return spherical_harmonics(degree, directions, torch.cat([first[:, None], rest], dim=1))


class RecordableGsplat(GsplatBackend):
    """gsplat that CUDA graphs can record: nothing waits for the GPU, and all work is on torch's current stream.

    Tiles get our own lists, shorter than gsplat's. Colours, and blending with gradients, have kernels of our own.
    ``capacity`` is for tile/Gaussian pairs.
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


def _project(inputs: Inputs, viewmats: Tensor, Ks: Tensor) -> Splats:
    """Project Gaussians to the screens of views, transforms ``[V, 4, 4]`` and intrinsics ``[V, 3, 3]``."""
    from gsplat import fully_fused_projection

    opacities, quats = inputs.opacities, inputs.quats
    identity = constant((1.0, 0.0, 0.0, 0.0), quats.dtype, quats.device)
    quats = torch.where((quats == 0).all(dim=-1, keepdim=True), identity, quats)  # the kernels divide by the length
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        *(inputs.means, None, quats, inputs.scales),
        *(viewmats, Ks, inputs.camera.width, inputs.camera.height),
        near_plane=inputs.near_plane,
        far_plane=inputs.far_plane,
        calc_compensations=inputs.antialiased,
        **({"opacities": opacities} if is_gsplat_1_5() else {}),
    )
    opacities = opacities.expand(len(viewmats), -1) if compensations is None else opacities * compensations
    return Splats(radii, means2d, depths, conics, opacities)


def check_kernels_take(tensor: Tensor) -> None:
    """Raise ``BackendError`` unless a tensor is float32 on a CUDA device."""
    if tensor.dtype != torch.float32 or tensor.device.type != "cuda":
        raise BackendError(
            f"gsplat takes float32 on cuda, not {tensor.dtype} on {tensor.device}; convert, or use 'reference'"
        )
