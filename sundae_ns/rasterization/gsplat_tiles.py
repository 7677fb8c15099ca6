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

BOX = r"""
__device__ __forceinline__ float nearest(float low, float high) { return low > 0 ? low : high < 0 ? high : 0.0f; }

__device__ __forceinline__ float within(float value, float low, float high) {
    return value < low ? low : value > high ? high : value;
}

// Whether a primitive's exponent, a dx^2 + 2 b dx dy + c dy^2, exceeds its reach in all pixels of a box. The box goes
// around the pixels' centres, relative to the primitive's. The exponent is least at dy = slope_down dx in a column, and
// at dx = slope_across dy in a row. If the primitive's centre is outside the box, the least exponent lies on an edge
// that faces the centre. NaN returns false, which leaves the decision to the blending.
__device__ __forceinline__ bool misses_box(float a, float b, float c, float slope_down, float slope_across, float reach,
                                           float left, float right, float up, float down) {
    const float near_x = nearest(left, right), near_y = nearest(up, down);
    float squares = 0, least = 0;  // in thin primitives large terms cancel: the slack grows with them
    if (near_x != 0) {
        const float dy = within(slope_down * near_x, up, down);
        squares = a * near_x * near_x + c * dy * dy;
        least = squares + 2 * b * near_x * dy;
    }
    if (near_y != 0) {
        const float dx = within(slope_across * near_y, left, right);
        const float other = a * dx * dx + c * near_y * near_y, sum = other + 2 * b * dx * near_y;
        if (near_x == 0 || !(sum >= least)) {
            squares = other;
            least = sum;
        }
    }
    return least > reach + ROUNDING * (1 + squares);
}
"""
"""CUDA source of ``misses_box``; needs the macro ``ROUNDING``."""

SOURCE = (
    BOX
    + r"""
struct Footprint {
    float x, y, a, b, c;           // centre in pixels; the exponent is a dx^2 + 2 b dx dy + c dy^2
    float down, across;            // where it is least: dy = down dx in a column, dx = across dy in a row
    float reach;                   // largest exponent that is still blended
    int first, last, top, bottom;  // tiles of the bounding square: columns and rows, ends excluded
};

__device__ __forceinline__ int clamped(float value, int most) {
    return value > 0 ? value < most ? (int)value : most : 0;
}

// Whether no pixel of a tile blends the primitive.
__device__ __forceinline__ bool misses(const Footprint& f, int column, int row, int width, int height) {
    const int wide = width - column * TILE, high = height - row * TILE;
    const float left = column * TILE + 0.5f - f.x, right = left + (wide < TILE ? wide : TILE) - 1;
    const float up = row * TILE + 0.5f - f.y, down = up + (high < TILE ? high : TILE) - 1;
    return misses_box(f.a, f.b, f.c, f.down, f.across, f.reach, left, right, up, down);
}

// The touched tiles of one row. They are adjacent, because the exponent is convex. Bisect on both sides of the tile
// where it is least.
__device__ __forceinline__ void span(const Footprint& f, int row, int width, int height, int* from, int* to) {
    const int high = height - row * TILE;
    const float up = row * TILE + 0.5f - f.y, near_y = nearest(up, up + (high < TILE ? high : TILE) - 1);
    int seed = clamped(floorf((f.x + f.across * near_y) / TILE), f.last - 1);
    if (seed < f.first) seed = f.first;
    *from = *to = seed;
    if (misses(f, seed, row, width, height)) {
        // The least exponent may lie in the one-pixel gap between two tiles, and either may be nearer.
        if (seed + 1 < f.last && !misses(f, seed + 1, row, width, height))
            ++seed;
        else if (seed > f.first && !misses(f, seed - 1, row, width, height))
            --seed;
        else
            return;
    }
    for (int low = f.first, up_to = seed;;) {
        *from = up_to;
        if (low >= up_to) break;
        const int middle = (low + up_to) / 2;
        if (misses(f, middle, row, width, height)) low = middle + 1;
        else up_to = middle;
    }
    for (int low = seed + 1, up_to = f.last;;) {
        *to = low;
        if (low >= up_to) break;
        const int middle = (low + up_to) / 2;
        if (misses(f, middle, row, width, height)) up_to = middle;
        else low = middle + 1;
    }
}

__device__ __forceinline__ Footprint footprint(int i, const float* __restrict__ means, const float* __restrict__ conics,
                                               const float* __restrict__ opacities, const int* __restrict__ radii,
                                               int axes, int columns, int rows) {
    Footprint f;
    const float rx = radii[i * axes], ry = radii[i * axes + axes - 1];
    f.first = f.last = f.top = f.bottom = 0;
    if (rx <= 0 || ry <= 0) return f;
    f.x = means[2 * i];
    f.y = means[2 * i + 1];
    const float u = f.x / TILE, v = f.y / TILE, p = rx / TILE, q = ry / TILE;
    f.first = clamped(floorf(u - p), columns);
    f.last = clamped(ceilf(u + p), columns);
    f.top = clamped(floorf(v - q), rows);
    f.bottom = clamped(ceilf(v + q), rows);
    f.a = 0.5f * conics[3 * i];
    f.b = 0.5f * conics[3 * i + 1];
    f.c = 0.5f * conics[3 * i + 2];
    f.down = -f.b / f.c;
    f.across = -f.b / f.a;
    f.reach = logf(opacities[i] * 255.0f);
    return f;
}

#define FIELD int n, int lanes, const long long* __restrict__ order, const float* __restrict__ means, \
    const float* __restrict__ conics, const float* __restrict__ opacities, const int* __restrict__ radii, int axes, \
    int width, int height, int columns, int rows

// The tiles of one thread, which takes every `lanes`-th row of one primitive; primitives are in order of depth.
// Returns the number of tiles; with `tiles`, also writes them from `at` on, up to the capacity.
__device__ __forceinline__ int walk(FIELD, int thread, TileId* tiles, int* primitives, long long at, int capacity) {
    const int i = (int)order[thread / lanes];
    const Footprint f = footprint(i, means, conics, opacities, radii, axes, columns, rows);
    if (f.first >= f.last) return 0;
    const long long start = at;
    for (int row = f.top + thread % lanes; row < f.bottom; row += lanes) {
        int from, to;
        span(f, row, width, height, &from, &to);
        if (!tiles)
            at += to - from;
        else
            for (; from < to && at < capacity; ++from, ++at) {
                tiles[at] = (TileId)(row * columns + from);
                primitives[at] = i;
            }
    }
    return (int)(at - start);
}

#define WALK(...) \
    walk(n, lanes, order, means, conics, opacities, radii, axes, width, height, columns, rows, __VA_ARGS__)

extern "C" __global__ void count_tiles(FIELD, int* __restrict__ counts) {
    const long long thread = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (thread < (long long)n * lanes) counts[thread] = WALK((int)thread, 0, 0, 0, 0);
}

// `ends` is the inclusive prefix sum of `counts`.
extern "C" __global__ void list_tiles(FIELD, const int* __restrict__ counts, const long long* __restrict__ ends,
                                      int capacity, TileId* __restrict__ tiles, int* __restrict__ primitives) {
    const long long thread = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (thread < (long long)n * lanes)
        WALK((int)thread, tiles, primitives, ends[thread] - counts[thread], capacity);
}
"""
)


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
    kernels = load_kernels(SOURCE, ("count_tiles", "list_tiles"), listing_options(dtype), device)
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
    """Compiler options of :data:`SOURCE` for tile numbers of a dtype, int16 or int32."""
    number = "short" if dtype == torch.int16 else "int"
    return (f"-DTILE={TILE}", f"-DROUNDING={ROUNDING}f", f"-DTileId={number}")
