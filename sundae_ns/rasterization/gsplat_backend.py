"""The CUDA backend: gsplat 1.4 and 1.5 behind one interface. gsplat is imported only inside functions."""

from __future__ import annotations

import functools
import inspect

import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.rasterization.constants import constant
from sundae_ns.rasterization.gsplat_blending import blend
from sundae_ns.rasterization.gsplat_colors import harmonic_colors
from sundae_ns.rasterization.gsplat_tiles import TILE, Capacity, TileLists, tile_lists
from sundae_ns.rasterization.reference import ReferenceBackend, largest_axis, strategy_info
from sundae_ns.rasterization.types import Inputs, Rasterization

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
        width, height = inputs.width, inputs.height
        radii, means2d, depths, conics, seen_opacities = project(
            *(inputs.means, inputs.quats, inputs.scales, inputs.opacities, inputs.viewmat, inputs.K, width, height),
            near_plane=inputs.near_plane,
            far_plane=inputs.far_plane,
            antialiased=inputs.antialiased,
        )
        lists = self._lists(means2d, conics, seen_opacities, depths, radii, width, height)
        channels = inputs.colors
        if inputs.render_depth:
            channels = torch.cat([channels, depths[0, :, None]], dim=1)
        # Each pass overwrites absgrad with that of its own channels, so absgrad allows one pass only.
        passes = [channels] if inputs.absgrad else channels.split(_CHANNELS_PER_PASS, dim=1)
        blended = [
            self._blend(means2d, conics, part[None], seen_opacities, lists, width, height, absgrad=inputs.absgrad)
            for part in passes
        ]
        alpha = blended[0][1][0]
        image = blended[0][0][0] if len(blended) == 1 else torch.cat([part[0] for part, _ in blended], dim=-1)
        depth = None
        if inputs.render_depth:
            image, depth = image[..., :-1], image[..., -1:] / alpha.clamp(min=1e-10)
        return Rasterization(
            colors=image,
            depth=depth,
            alpha=alpha,
            radii=largest_axis(radii[0]),
            info=strategy_info(means2d, radii, width, height),
        )

    def _lists(
        self, means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, radii: Tensor, width: int, height: int
    ) -> TileLists:
        return TileLists(*square_lists(means2d, radii, depths, width, height))

    def _blend(
        self,
        means2d: Tensor,
        conics: Tensor,
        colors: Tensor,
        opacities: Tensor,
        lists: TileLists,
        width: int,
        height: int,
        *,
        absgrad: bool,
    ) -> tuple[Tensor, Tensor]:
        from gsplat import rasterize_to_pixels

        return rasterize_to_pixels(
            means2d,
            conics,
            colors,
            opacities,
            width,
            height,
            TILE,
            lists.starts,
            lists.primitives,
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
    """gsplat with what CUDA graphs need: nothing waits for the GPU, and all work is on torch's current stream.

    Tiles get our own lists, shorter than gsplat's. Colours, and blending with gradients, have kernels of our own.

    Args:
        capacity: for tile/primitive pairs.
    """

    def __init__(self, capacity: Capacity) -> None:
        self._capacity = capacity

    def _lists(
        self, means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, radii: Tensor, width: int, height: int
    ) -> TileLists:
        return tile_lists(
            means2d[0], conics[0], opacities[0], depths[0], radii[0], width, height, capacity=self._capacity
        )

    def _blend(
        self,
        means2d: Tensor,
        conics: Tensor,
        colors: Tensor,
        opacities: Tensor,
        lists: TileLists,
        width: int,
        height: int,
        *,
        absgrad: bool,
    ) -> tuple[Tensor, Tensor]:
        arguments = (means2d, conics, colors, opacities, lists, width, height)
        if torch.is_grad_enabled() and any(value.requires_grad for value in arguments[:4]):
            return blend(*arguments, absgrad=absgrad)
        return super()._blend(*arguments, absgrad=absgrad)  # frames stay gsplat's to the bit

    def harmonic_colors(
        self, degree: int, means: Tensor, center: Tensor, features_dc: Tensor, features_rest: Tensor
    ) -> Tensor:
        """See :func:`sundae_ns.rasterization.harmonic_colors`.

        Raises:
            BackendError: The tensors are not float32 on a CUDA device, or the kernels cannot be compiled.
        """
        _check_kernels_take(means)
        return harmonic_colors(degree, means, center, features_dc, features_rest)


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float,
    far_plane: float = 1e10,
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Project primitives to the screen with gsplat; arguments are those of ``rasterize``.

    Returns:
        Radii ``[1, N]`` (``[1, N, 2]`` from gsplat 1.5 on), centres ``[1, N, 2]``, depths ``[1, N]``,
        conics ``[1, N, 3]``, and the opacities to blend ``[1, N]``.
    """
    from gsplat import fully_fused_projection

    radii, means2d, depths, conics, compensations = fully_fused_projection(
        means,
        None,
        _without_zeros(quats),
        scales,
        viewmat[None],
        K[None],
        width,
        height,
        near_plane=near_plane,
        far_plane=far_plane,
        calc_compensations=antialiased,
        **({"opacities": opacities} if _projection_takes_opacities() else {}),
    )
    return radii, means2d, depths, conics, opacities[None] if compensations is None else opacities * compensations


def square_lists(means2d: Tensor, radii: Tensor, depths: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """gsplat's own lists: every tile that a primitive's bounding square touches.

    Args:
        means2d: centres in each of C images ``[C, N, 2]``, pixels.
        radii: ``[C, N]``, or one per axis ``[C, N, 2]``.
        depths: camera z ``[C, N]``.
        width: image width in pixels.
        height: image height in pixels.

    Returns:
        Start of each tile's list ``[C, rows, columns]``, and the primitives of all lists, numbered across all images.
    """
    from gsplat import isect_offset_encode, isect_tiles

    columns, rows = -(-width // TILE), -(-height // TILE)
    _, pairs, primitives = isect_tiles(means2d, radii, depths, TILE, columns, rows)
    return isect_offset_encode(pairs, len(means2d), columns, rows), primitives


@functools.cache
def _projection_takes_opacities() -> bool:
    """Whether this gsplat (1.5 or newer) fits radii to opacities."""
    from gsplat import fully_fused_projection

    return "opacities" in inspect.signature(fully_fused_projection).parameters


def _check_kernels_take(tensor: Tensor) -> None:
    if tensor.dtype != torch.float32 or tensor.device.type != "cuda":
        raise BackendError(
            f"gsplat takes float32 on cuda, not {tensor.dtype} on {tensor.device}; convert, or use 'reference'"
        )


def _without_zeros(quats: Tensor) -> Tensor:
    """Replace all-zero quaternions by the identity, because the kernels divide by the length."""
    is_zero = (quats == 0).all(dim=-1, keepdim=True)
    return torch.where(is_zero, constant((1.0, 0.0, 0.0, 0.0), quats.dtype, quats.device), quats)
