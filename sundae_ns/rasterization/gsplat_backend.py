"""The CUDA backend: gsplat 1.4 and 1.5 behind one interface. gsplat is imported only inside these functions."""

from __future__ import annotations

import functools
import inspect

import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.rasterization.constants import constant
from sundae_ns.rasterization.gsplat_harmonics import harmonics
from sundae_ns.rasterization.gsplat_tiles import TILE, Room, tile_lists
from sundae_ns.rasterization.reference import ReferenceBackend, largest_axis
from sundae_ns.rasterization.types import Rasterization

_CHANNELS_PER_PASS = 32


class GsplatBackend:
    """The kernels of gsplat; float32 tensors on a CUDA device.

    Args:
        room: for pairs of a tile and a primitive, where views are to be recorded: the tiles get lists of our own, which are
            shorter than gsplat's, and nothing has to be waited for; harmonics have no gradients. None: gsplat's kernels.
    """

    name = "gsplat"

    def __init__(self, room: Room | None = None) -> None:
        self._room = room

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
        from gsplat import rasterize_to_pixels

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
        radii, means2d, depths, conics, seen_opacities = project(
            means,
            quats,
            scales,
            opacities,
            viewmat,
            K,
            width,
            height,
            near_plane=near_plane,
            far_plane=far_plane,
            antialiased=antialiased,
        )
        starts, primitives = self._lists(means2d, conics, seen_opacities, depths, radii, width, height)
        channels = torch.cat([colors, depths[0, :, None]], dim=1) if render_depth else colors
        # Each pass overwrites absgrad with that of its own channels, so with absgrad there must be one pass only.
        passes = [channels] if absgrad else channels.split(_CHANNELS_PER_PASS, dim=1)
        blended = [
            rasterize_to_pixels(
                means2d,
                conics,
                some[None],
                seen_opacities,
                width,
                height,
                TILE,
                starts,
                primitives,
                absgrad=absgrad,
            )
            for some in passes
        ]
        alpha = blended[0][1][0]
        picture = blended[0][0][0] if len(blended) == 1 else torch.cat([part[0] for part, _ in blended], dim=-1)
        depth = None
        if render_depth:
            picture, depth = picture[..., :-1], picture[..., -1:] / alpha.clamp(min=1e-10)
        return Rasterization(
            colors=picture,
            depth=depth,
            alpha=alpha,
            radii=largest_axis(radii[0]),
            info={
                "means2d": means2d,
                "radii": radii,
                "width": width,
                "height": height,
                "n_cameras": 1,
                "gaussian_ids": None,
            },
        )

    def _lists(
        self, means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, radii: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """Where the list of each tile begins, and the primitives of all lists."""
        if self._room is None:
            return square_lists(means2d, radii, depths, width, height)
        lists = tile_lists(means2d[0], conics[0], opacities[0], depths[0], radii[0], width, height, room=self._room)
        return lists.starts, lists.primitives

    def spherical_harmonics(self, degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
        """Sum of harmonics ``[N, 3]`` for directions ``[N, 3]`` (not zero) and coefficients ``[N, K, 3]``.

        Raises:
            BackendError: The tensors are not float32 on a CUDA device.
        """
        from gsplat import spherical_harmonics

        _check_kernels_take(directions)
        if directions.shape[0] == 0:
            return ReferenceBackend().spherical_harmonics(degree, directions, coeffs)
        if self._room is not None:
            return harmonics(degree, directions, coeffs)
        return spherical_harmonics(degree, directions, coeffs)


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
    """How primitives lie in a picture, as gsplat's projection has it; arguments are those of ``rasterize``.

    Returns:
        Radii ``[1, N]`` (``[1, N, 2]`` from gsplat 1.5 on), centres ``[1, N, 2]``, depths ``[1, N]``, conics ``[1, N, 3]``, and
        the opacities that are blended ``[1, N]``.
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
    """gsplat's own lists, of all tiles that a primitive's square touches.

    Args:
        means2d: centres in each of C pictures ``[C, N, 2]``, pixels.
        radii: ``[C, N]``, or one for each axis ``[C, N, 2]``.
        depths: camera z ``[C, N]``.
        width: of the pictures, pixels.
        height: likewise.

    Returns:
        Where the list of each tile begins ``[C, rows, columns]``, and the primitives of all lists, numbered through all
        pictures.
    """
    from gsplat import isect_offset_encode, isect_tiles

    columns, rows = -(-width // TILE), -(-height // TILE)
    _, pairs, primitives = isect_tiles(means2d, radii, depths, TILE, columns, rows)
    return isect_offset_encode(pairs, len(means2d), columns, rows), primitives


@functools.cache
def _projection_takes_opacities() -> bool:
    """Whether this gsplat (from 1.5 on) fits radii to them."""
    from gsplat import fully_fused_projection

    return "opacities" in inspect.signature(fully_fused_projection).parameters


def _check_kernels_take(tensor: Tensor) -> None:
    if tensor.dtype != torch.float32 or tensor.device.type != "cuda":
        raise BackendError(
            f"gsplat takes float32 on cuda, not {tensor.dtype} on {tensor.device}; convert, or use 'reference'"
        )


def _without_zeros(quats: Tensor) -> Tensor:
    """Replace all-zero quaternions by the identity; the kernels would divide by their length."""
    is_zero = (quats == 0).all(dim=-1, keepdim=True)
    return torch.where(is_zero, constant((1.0, 0.0, 0.0, 0.0), quats.dtype, quats.device), quats)
