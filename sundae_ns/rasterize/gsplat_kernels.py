"""Our CUDA kernels in gsplat's pipeline: tile lists, blending with gradients, and colours.

All run on torch's current stream and wait for nothing, so CUDA graphs can record them.

- ``csrc/tiles.cu``: gsplat 1.4 lists a Gaussian in every tile of its three-sigma square. A thin or faint one is then in
  hundreds of tiles where no pixel blends it, and every pixel still evaluates it. The lists here leave those pairs out;
  which Gaussians are blended, and in which order, stays the same to the bit.
- ``csrc/blending.cu``: gsplat's backward pass sums each value of a Gaussian over the pixels of a warp by five
  exchanges. Here the lanes of a warp halve the values while they exchange them: 32 values take 31 exchanges in place of
  160. For the gradient of alpha a thread keeps one number, not one for each channel.
- ``csrc/colors.cu``: gsplat 1.4 launches its harmonics on CUDA's default stream, which a CUDA graph does not record.
  These kernels also read the coefficients without a copy that joins both parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.cuda.kernels import Argument, load_kernels
from sundae_ns.rasterize.reference import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

TILE = 16  # Side of gsplat's tiles, pixels
LANES = 32  # threads of a warp
_PIXELS = TILE * TILE  # of a tile, and threads of a block that blends one
_PER_BLOCK = 128  # Gaussians of a block of threads, which reads and writes their coefficients as one piece
_ROUNDING = "-DROUNDING=1e-5f"  # slack on exponents, relative to their terms: rounding never drops a blended Gaussian


class Splats(NamedTuple):
    """Gaussians on the screen of one image, as gsplat projects them; float32. Of V views ``[V, N]``."""

    radii: Tensor  # int32 [1, N]; one per axis [1, N, 2] from gsplat 1.5 on; 0 where a Gaussian is culled
    means2d: Tensor  # centres in pixels [1, N, 2]
    depths: Tensor  # camera z [1, N]
    conics: Tensor  # inverse covariances, upper triangle [1, N, 3]
    opacities: Tensor  # opacities to blend [1, N]


# --------------------------------------------------------------------------------------------------------------- tiles


@dataclass
class Capacity:
    """Number of tile/Gaussian pairs to allocate, so that nothing waits for the GPU to count them."""

    pairs: int | None = None  # Length of the lists; None for as many as needed
    needed: list[Tensor] = field(default_factory=list)
    """Number of pairs of each call so far, int64 ``[]`` each; lists that needed more than ``pairs`` are incomplete."""


@dataclass(frozen=True)
class GsplatLists:
    """Lists of tiles in row-major order, each front to back, as gsplat's ``rasterize_to_pixels`` reads them."""

    width: int  # of the image, pixels
    height: int
    starts: Tensor  # start of each tile's list, int32 [1, rows, columns]
    gaussians: Tensor  # indices of Gaussians, int32 [L]
    drawn: Tensor | None = None  # tiles of the image, bool [1, rows, columns]; None if all are


@torch.no_grad()
def tile_lists(splats: Splats, width: int, height: int, *, capacity: Capacity) -> GsplatLists:
    """Lists of the Gaussians that each tile of a view blends: alpha is at least 1/255 in one of its pixels.

    The number of pairs needed is appended to ``capacity``. Without a limit this waits once for the device. With a
    limit, an extra row of tiles below the image takes the unused pairs. ``BackendError`` without the kernels.
    """
    radii, means2d, depths, conics, opacities = (value.contiguous() for value in splats)
    device = means2d.device
    columns, rows = -(-width // TILE), -(-height // TILE)
    dtype = torch.int16 if columns * (rows + 1) <= torch.iinfo(torch.int16).max else torch.int32
    kernels = load_kernels("tiles.cu", ("count_tiles", "list_tiles"), listing_options(dtype), device)
    n = means2d.shape[1]
    lanes = 32 if n < 2**17 else 8  # threads for the rows of tiles of a Gaussian: few ones may each be large
    order = depths[0].argsort(stable=True)
    geometry = (n, lanes, order, means2d, conics, opacities, radii, radii.ndim - 1, width, height, columns, rows)
    counts = torch.empty(n * lanes, dtype=torch.int32, device=device)
    kernels["count_tiles"](n * lanes, [*geometry, counts])
    ends = counts.cumsum(0)
    capacity.needed.append(ends[-1].clone())  # a view would keep the sums of all Gaussians
    pairs, below = (int(ends[-1]), 0) if capacity.pairs is None else (capacity.pairs, 1)
    tiles = torch.full((pairs,), columns * rows, dtype=dtype, device=device)
    gaussians = torch.zeros(pairs, dtype=torch.int32, device=device)
    kernels["list_tiles"](n * lanes, [*geometry, counts, ends, pairs, tiles, gaussians])
    tiles, by_tile = torch.sort(tiles, stable=True)  # stable, so each list stays in order of depth
    numbers = torch.arange(columns * (rows + below), dtype=dtype, device=device)
    starts = torch.searchsorted(tiles, numbers, out_int32=True)
    shape = (1, rows + below, columns)
    # Gradients would walk through the unused pairs, so their tiles are marked.
    drawn = (numbers < columns * rows).view(shape) if below else None
    return GsplatLists(width, height, starts.view(shape), gaussians.index_select(0, by_tile), drawn)


def listing_options(dtype: torch.dtype) -> tuple[str, ...]:
    """Compiler options of ``tiles.cu`` for tile numbers of a dtype, int16 or int32."""
    return (f"-DTILE={TILE}", _ROUNDING, f"-DTileId={'short' if dtype == torch.int16 else 'int'}")


# ------------------------------------------------------------------------------------------------------------ blending


def blending_options(channels: int, *, absgrad: bool) -> tuple[str, ...]:
    """Compiler options of ``blending.cu``; with ``absgrad`` it also sums absolute gradients of the centres."""
    values = channels + (8 if absgrad else 6)
    numbers = {"TILE": TILE, "THREADS": _PIXELS, "LANES": LANES, "CHANNELS": channels, "VALUES": values}
    numbers |= {"PADDED": -(-channels // 4) * 4, "SLOTS": 1 << (values - 1).bit_length(), "ABSOLUTE": int(absgrad)}
    limits = {"MAX_ALPHA": MAX_ALPHA, "MIN_ALPHA": MIN_ALPHA, "MIN_TRANSMITTANCE": MIN_TRANSMITTANCE}
    words = [f"-D{name}={number}" for name, number in numbers.items()]
    return *words, *(f"-D{name}={limit:.9e}f" for name, limit in limits.items()), _ROUNDING


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, lists: GsplatLists, absgrad: bool
    ) -> tuple[Tensor, Tensor]:
        width, height = lists.width, lists.height
        splats = [value.contiguous() for value in (means2d, conics, colors, opacities)]
        image = colors.new_empty(1, height, width, colors.shape[-1])
        alphas = colors.new_empty(1, height, width, 1)
        transmittances = torch.empty_like(alphas)  # 1 - alpha would round them to multiples of 6e-8
        stops = torch.empty(height, width, dtype=torch.int32, device=colors.device)
        tiles = -(-width // TILE) * -(-height // TILE)
        ctx.lists = [width, height, tiles, lists.starts.numel(), len(lists.gaussians), lists.starts, lists.gaussians]
        options = blending_options(colors.shape[-1], absgrad=absgrad)
        ctx.kernels = load_kernels("blending.cu", ("blend", "blend_backward"), options, colors.device, _PIXELS)
        ctx.kernels["blend"](tiles * _PIXELS, [*ctx.lists, *splats, image, alphas, transmittances, stops])
        ctx.save_for_backward(means2d, *splats, transmittances, stops)
        ctx.absgrad = absgrad
        return image, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, grad_alphas: Tensor) -> tuple[Tensor | None, ...]:
        centers, *saved = ctx.saved_tensors
        grads = [torch.zeros_like(value) for value in saved[:4]]
        absolute = torch.zeros_like(saved[0]) if ctx.absgrad else None
        arguments: list[Argument] = [*ctx.lists, *saved, grad_image.contiguous(), grad_alphas.contiguous()]
        ctx.kernels["blend_backward"](ctx.lists[2] * _PIXELS, [*arguments, *grads, absolute])
        if ctx.absgrad:
            centers.absgrad = absolute
        return *grads, None, None


blend = _Blend.apply
"""Blend splats to an image ``[1, H, W, C]`` and its alpha ``[1, H, W, 1]``; once differentiable.

It takes centres ``[1, N, 2]`` in pixels, conics ``[1, N, 3]``, colours ``[1, N, C]``, opacities ``[1, N]``, the tile
lists, and ``absgrad``, all on a CUDA device. Lists of tiles outside the image are ignored. With ``absgrad`` the
backward pass sets that of the centres, as :func:`sundae_ns.rasterize.reference.composite` does.
"""


# ------------------------------------------------------------------------------------------------------------- colours

COLOR_OPTIONS = (f"-DPER_BLOCK={_PER_BLOCK}", "-DMOST_REST=72")  # 24 coefficients of three channels, of SH degree 4
"""Compiler options of ``colors.cu``."""


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, degree: int, means: Tensor, center: Tensor, dc: Tensor, rest: Tensor
    ) -> Tensor:
        means, center, dc, rest = (value.contiguous() for value in (means, center, dc, rest))
        colors = torch.empty_like(means)
        names = ("harmonic_colors", "harmonic_colors_backward")
        ctx.kernels = load_kernels("colors.cu", names, COLOR_OPTIONS, means.device, _PER_BLOCK)
        numbers = [len(means), degree, means, center, int(center.ndim > 1)]
        ctx.kernels["harmonic_colors"](colors.numel(), [*numbers, dc, rest, rest.shape[1], colors])
        ctx.save_for_backward(means, center, dc, rest, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        means, center, dc, rest, colors = ctx.saved_tensors
        grad_means, grad_dc = torch.empty_like(means), torch.empty_like(dc)
        grad_rest = torch.empty_like(rest) if ctx.needs_input_grad[4] else None
        threads = -(-len(means) // _PER_BLOCK) * _PER_BLOCK
        given = [len(means), ctx.degree, means, center, int(center.ndim > 1), rest, rest.shape[1], colors]
        given += [gradient.contiguous(), grad_means, grad_dc, grad_rest]
        ctx.kernels["harmonic_colors_backward"](threads, given)
        # Only differences of places count.
        grad_center = -grad_means.sum_to_size(center.shape) if ctx.needs_input_grad[2] else None
        return None, grad_means, grad_center, grad_dc, grad_rest


harmonic_colors = _Colors.apply
"""As :func:`sundae_ns.rasterize.interface.harmonic_colors`, for float32 tensors on a CUDA device."""
