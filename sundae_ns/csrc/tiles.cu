#include "box.cuh"

struct Footprint {
    float x, y, a, b, c;           // centre in pixels; the exponent is a dx^2 + 2 b dx dy + c dy^2
    float down, across;            // where it is least: dy = down dx in a column, dx = across dy in a row
    float reach;                   // largest exponent that is still blended
    int first, last, top, bottom;  // tiles of the bounding square: columns and rows, ends excluded
};

__device__ __forceinline__ int clamped(float value, int most) {
    return value > 0 ? value < most ? (int)value : most : 0;
}

// Whether no pixel of a tile blends the Gaussian.
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

// The tiles of one thread, which takes every `lanes`-th row of one Gaussian; Gaussians are in order of depth.
// Returns the number of tiles; with `tiles`, also writes them from `at` on, up to the capacity.
__device__ __forceinline__ int walk(FIELD, int thread, TileId* tiles, int* gaussians, long long at, int capacity) {
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
                gaussians[at] = i;
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
                                      int capacity, TileId* __restrict__ tiles, int* __restrict__ gaussians) {
    const long long thread = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (thread < (long long)n * lanes)
        WALK((int)thread, tiles, gaussians, ends[thread] - counts[thread], capacity);
}
