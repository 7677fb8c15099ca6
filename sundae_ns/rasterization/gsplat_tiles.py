"""Lists of the primitives that each 16-pixel tile blends under gsplat: alpha is at least 1/255 in one of its pixels.

gsplat 1.4 lists a primitive in every tile of its three-sigma square. A thin or faint primitive is then in hundreds of
tiles where no pixel blends it, and every pixel still evaluates it. The lists here leave those pairs out; which
primitives are blended, and in which order, stays the same to the bit.

:mod:`sundae_ns.rasterization.tiles` does the same for the reference.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import load_kernels

TILE = 16
"""Side of gsplat's tiles, pixels."""

ROUNDING = 1e-5
"""Slack on exponents, relative to the terms of their sum, so that rounding never drops a blended primitive."""


class Splats(NamedTuple):
    """Primitives on the screen of one image, as gsplat projects them; float32, contiguous. Of V views ``[V, N]``."""

    radii: Tensor
    """int32 ``[1, N]``; one per axis ``[1, N, 2]`` from gsplat 1.5 on; 0 where a primitive is culled."""
    means2d: Tensor
    """Centres in pixels ``[1, N, 2]``."""
    depths: Tensor
    """Camera z ``[1, N]``."""
    conics: Tensor
    """Inverse covariances, upper triangle ``[1, N, 3]``."""
    opacities: Tensor
    """Opacities to blend ``[1, N]``."""


@dataclass
class Capacity:
    """Number of tile/primitive pairs to allocate, so that nothing waits for the GPU to count them."""

    pairs: int | None = None
    """Length of the lists; None for as many as needed."""
    needed: list[Tensor] = field(default_factory=list)
    """Number of pairs of each call so far, int64 ``[]`` each; lists that needed more than ``pairs`` are incomplete."""


@dataclass(frozen=True)
class GsplatLists:
    """Lists of tiles in row-major order, each front to back, as gsplat's ``rasterize_to_pixels`` reads them."""

    width: int
    """Width of the image, pixels."""
    height: int
    """Height of the image, pixels."""
    starts: Tensor
    """Start of each tile's list, int32 ``[1, rows, columns]``."""
    primitives: Tensor
    """Indices, int32 ``[L]``."""
    drawn: Tensor | None = None
    """Tiles of the image, bool ``[1, rows, columns]``; None if all are."""


@torch.no_grad()
def tile_lists(splats: Splats, width: int, height: int, *, capacity: Capacity) -> GsplatLists:
    """Tile lists of one view.

    Args:
        splats: the primitives, on a CUDA device.
        width: image width in pixels.
        height: image height in pixels.
        capacity: number of pairs to allocate; the number needed is appended to it. Without a limit this waits once for
            the device. With a limit, an extra row of tiles below the image takes the unused pairs.

    Raises:
        BackendError: the kernels cannot be compiled or loaded.
    """
    radii, means2d, depths, conics, opacities = splats
    device = means2d.device
    columns, rows = -(-width // TILE), -(-height // TILE)
    dtype = torch.int16 if columns * (rows + 1) <= torch.iinfo(torch.int16).max else torch.int32
    kernels = load_kernels("tiles.cu", ("count_tiles", "list_tiles"), listing_options(dtype), device)
    n = means2d.shape[1]
    lanes = lanes_per_primitive(n)
    order = depths[0].argsort(stable=True)
    geometry = (n, lanes, order, means2d, conics, opacities, radii, radii.ndim - 1, width, height, columns, rows)
    counts = torch.empty(n * lanes, dtype=torch.int32, device=device)
    kernels["count_tiles"](n * lanes, [*geometry, counts])
    ends = counts.cumsum(0)
    capacity.needed.append(ends[-1])
    if capacity.pairs is None:
        pairs, below = int(ends[-1]), 0
        tiles = torch.empty(pairs, dtype=dtype, device=device)
        primitives = torch.empty(pairs, dtype=torch.int32, device=device)
    else:
        pairs, below = capacity.pairs, 1
        tiles = torch.full((pairs,), columns * rows, dtype=dtype, device=device)
        primitives = torch.zeros(pairs, dtype=torch.int32, device=device)
    kernels["list_tiles"](n * lanes, [*geometry, counts, ends, pairs, tiles, primitives])
    tiles, by_tile = torch.sort(tiles, stable=True)  # stable, so each list stays in order of depth
    numbers = torch.arange(columns * (rows + below), dtype=dtype, device=device)
    starts = torch.searchsorted(tiles, numbers, out_int32=True)
    shape = (1, rows + below, columns)
    # Gradients would walk through the unused pairs, so their tiles are marked.
    drawn = (numbers < columns * rows).view(shape) if below else None
    return GsplatLists(width, height, starts.view(shape), primitives.index_select(0, by_tile), drawn)


def lanes_per_primitive(n: int) -> int:
    """Threads that share the rows of tiles of a primitive: few primitives may each be as large as the image."""
    return 32 if n < 2**17 else 8


def listing_options(dtype: torch.dtype) -> tuple[str, ...]:
    """Compiler options of ``tiles.cu`` for tile numbers of a dtype, int16 or int32."""
    number = "short" if dtype == torch.int16 else "int"
    return (f"-DTILE={TILE}", f"-DROUNDING={ROUNDING}f", f"-DTileId={number}")
