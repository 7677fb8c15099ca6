"""Which primitives each 16-pixel tile blends under gsplat: only those that reach an alpha of 1/255 in one of its pixels.

gsplat 1.4 gives a primitive to every tile of its three-sigma square. A needle across the picture, or a faint blob, is in
hundreds of tiles where no pixel would blend it, and each pixel of them looks at it all the same. The lists made here leave
those pairs out. What is blended, in which order, stays the same to the bit.

:mod:`sundae_ns.rasterization.tiles` does the same for the reference.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import Kernel

TILE = 16
"""Side of gsplat's tiles, pixels."""

ROUNDING = 1e-5
"""Slack on exponents, in proportion to the terms they are made of, so that rounding never drops what would be blended."""

SOURCE = r"""
struct Footprint {
    float x, y, a, b, c;           // centre, pixels; its exponent is a dx^2 + 2 b dx dy + c dy^2
    float down, across;            // where it is least: dy = down dx in a column, dx = across dy in a row
    float reach;                   // largest exponent that still counts
    int first, last, top, bottom;  // tiles of its square; columns and rows, the last ones excluded
};

__device__ __forceinline__ int clamped(float value, int most) {
    return value > 0 ? value < most ? (int)value : most : 0;
}

__device__ __forceinline__ float nearest(float low, float high) { return low > 0 ? low : high < 0 ? high : 0.0f; }

__device__ __forceinline__ float within(float value, float low, float high) {
    return value < low ? low : value > high ? high : value;
}

// Whether no pixel of a tile can blend it. The least exponent over the box of the tile's pixel centres lies, off the box,
// on an edge that faces the primitive's centre. NaN answers no, so that gsplat decides.
__device__ __forceinline__ bool misses(const Footprint& f, int column, int row, int width, int height) {
    const int wide = width - column * TILE, high = height - row * TILE;
    const float left = column * TILE + 0.5f - f.x, right = left + (wide < TILE ? wide : TILE) - 1;
    const float up = row * TILE + 0.5f - f.y, down = up + (high < TILE ? high : TILE) - 1;
    const float near_x = nearest(left, right), near_y = nearest(up, down);
    float squares = 0, least = 0;  // of a needle large terms cancel: what rounding may have made of them is granted
    if (near_x != 0) {
        const float dy = within(f.down * near_x, up, down);
        squares = f.a * near_x * near_x + f.c * dy * dy;
        least = squares + 2 * f.b * near_x * dy;
    }
    if (near_y != 0) {
        const float dx = within(f.across * near_y, left, right);
        const float other = f.a * dx * dx + f.c * near_y * near_y, sum = other + 2 * f.b * dx * near_y;
        if (near_x == 0 || !(sum >= least)) {
            squares = other;
            least = sum;
        }
    }
    return least > f.reach + ROUNDING * (1 + squares);
}

// The tiles of one row that it reaches are next to each other, since the exponent is convex. They are found from the one
// where it is least, by halving what lies on either side.
__device__ __forceinline__ void span(const Footprint& f, int row, int width, int height, int* from, int* to) {
    const int high = height - row * TILE;
    const float up = row * TILE + 0.5f - f.y, near_y = nearest(up, up + (high < TILE ? high : TILE) - 1);
    int seed = clamped(floorf((f.x + f.across * near_y) / TILE), f.last - 1);
    if (seed < f.first) seed = f.first;
    *from = *to = seed;
    if (misses(f, seed, row, width, height)) {
        // Between the pixel centres of two tiles is a gap of one pixel: where it is least in there, either may be nearer.
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

// The tiles of one thread, which has every so many-th row of one primitive, primitives being taken in order of depth.
// Returns their number; where there is a list, they are written down from `at` on, as far as there is room.
__device__ __forceinline__ int walk(FIELD, int thread, TileId* tiles, int* primitives, long long at, int room) {
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
            for (; from < to && at < room; ++from, ++at) {
                tiles[at] = (TileId)(row * columns + from);
                primitives[at] = i;
            }
    }
    return (int)(at - start);
}

#define WALK(...) walk(n, lanes, order, means, conics, opacities, radii, axes, width, height, columns, rows, __VA_ARGS__)

extern "C" __global__ void count_tiles(FIELD, int* __restrict__ counts) {
    const long long thread = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (thread < (long long)n * lanes) counts[thread] = WALK((int)thread, 0, 0, 0, 0);
}

// `ends`: the counts, added up to each thread and with it.
extern "C" __global__ void list_tiles(FIELD, const int* __restrict__ counts, const long long* __restrict__ ends, int room,
                                      TileId* __restrict__ tiles, int* __restrict__ primitives) {
    const long long thread = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (thread < (long long)n * lanes)
        WALK((int)thread, tiles, primitives, ends[thread] - counts[thread], room);
}
"""


@dataclass
class Room:
    """How many pairs of a tile and a primitive there is room for, so that nobody has to wait to learn how many there are."""

    pairs: int | None = None
    """Longest lists that are made; None: as long as needed."""
    needed: list[Tensor] = field(default_factory=list)
    """How many pairs there were, int64 ``[]`` each, for every list since; where that is more than the room, it lacks some."""


@dataclass(frozen=True)
class TileLists:
    """Primitives of each tile, tiles row by row, front to back within each, as gsplat's ``rasterize_to_pixels`` reads them."""

    starts: Tensor
    """Where the list of each tile begins, int32 ``[1, rows, columns]``."""
    primitives: Tensor
    """int32 ``[L]``"""


@torch.no_grad()
def tile_lists(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    depths: Tensor,
    radii: Tensor,
    width: int,
    height: int,
    *,
    room: Room,
) -> TileLists:
    """Lists for one view.

    Args:
        means2d: centres in pixels ``[N, 2]``; all float32 on a CUDA device, contiguous, as gsplat's projection returns them.
        conics: inverse covariances in the picture, upper triangle ``[N, 3]``.
        opacities: those that will be blended ``[N]``.
        depths: camera z ``[N]``.
        radii: int32 ``[N]``, or one for each axis ``[N, 2]``; 0 where a primitive is culled.
        width: of the picture, pixels.
        height: likewise.
        room: for how many pairs; without a limit, the device is waited for once. Is told how many there were. With a limit,
            a row of tiles below the picture takes what is left of it.

    Raises:
        BackendError: the kernels cannot be compiled or loaded here.
    """
    device = means2d.device
    columns, rows = -(-width // TILE), -(-height // TILE)
    dtype = torch.int16 if columns * (rows + 1) <= torch.iinfo(torch.int16).max else torch.int32
    count, fill = _compiled(device, dtype)
    n = len(means2d)
    lanes = lanes_of(n)
    order = depths.argsort(stable=True)
    axes = 1 if radii.ndim == 1 else 2
    seen = (n, lanes, order, means2d, conics, opacities, radii, axes, width, height, columns, rows)
    counts = torch.empty(n * lanes, dtype=torch.int32, device=device)
    count(n * lanes, [*seen, counts])
    ends = counts.cumsum(0)
    room.needed.append(ends[-1])
    if room.pairs is None:
        pairs, below = int(ends[-1]), 0
        tiles = torch.empty(pairs, dtype=dtype, device=device)
        primitives = torch.empty(pairs, dtype=torch.int32, device=device)
    else:
        pairs, below = room.pairs, 1
        tiles = torch.full((pairs,), columns * rows, dtype=dtype, device=device)
        primitives = torch.zeros(pairs, dtype=torch.int32, device=device)
    fill(n * lanes, [*seen, counts, ends, pairs, tiles, primitives])
    tiles, by_tile = torch.sort(tiles, stable=True)  # stable, so that each list stays in order of depth
    every = torch.arange(columns * (rows + below), dtype=dtype, device=device)
    starts = torch.searchsorted(tiles, every, out_int32=True)
    return TileLists(starts.view(1, rows + below, columns), primitives.index_select(0, by_tile))


def lanes_of(n: int) -> int:
    """Threads of each primitive, which share its rows of tiles: few primitives may be as large as the picture."""
    return 32 if n < 2**17 else 8


@functools.cache
def _compiled(device: torch.device, dtype: torch.dtype) -> tuple[Kernel, Kernel]:
    options = definitions(dtype)
    return Kernel(SOURCE, "count_tiles", device, options), Kernel(SOURCE, "list_tiles", device, options)


def definitions(dtype: torch.dtype) -> tuple[str, ...]:
    """Compiler options of :data:`SOURCE`, for tiles numbered in a dtype, int16 or int32."""
    number = "short" if dtype == torch.int16 else "int"
    return (f"-DTILE={TILE}", f"-DROUNDING={ROUNDING}f", f"-DTileId={number}")
