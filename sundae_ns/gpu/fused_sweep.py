"""Correlations of an image's patches with those of other images, seen through planes: one GPU kernel.

Built from PyTorch's operations, a plane sweep writes and reads each image of a plane dozens of times. Here a block of
threads samples another image for a tile of one plane into shared memory, and sums patches there by rows and columns.

The source is plain C++ except for the thread indices, so the tests compile the same source for the CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.gpu.nvrtc import Launch, load_kernels

TILE_WIDTH, TILE_HEIGHT = 32, 16
THREADS = 256

SOURCE = r"""
#define HALO (WINDOW - 1)
#define COLUMNS (TILE_WIDTH + HALO)
#define ROWS (TILE_HEIGHT + HALO)

__device__ __forceinline__ float limited(float value, float highest) {
    return fminf(fmaxf(value, 0.0f), highest);  // NaN becomes 0
}

// An image between the middles of its pixels; beyond the outer ones it stays as it is there.
__device__ __forceinline__ float sample(const float* __restrict__ image, int height, int width, float x, float y) {
    x = limited(x - 0.5f, width - 1);
    y = limited(y - 0.5f, height - 1);
    const int left = (int)x, top = (int)y, right = left + 1 < width ? left + 1 : left;
    const float across = x - left, down = y - top;
    const float *above = image + top * width, *below = image + (top + 1 < height ? top + 1 : top) * width;
    return (1 - down) * ((1 - across) * above[left] + across * above[right]) +
           down * ((1 - across) * below[left] + across * below[right]);
}

// A block has one tile of one plane. A pixel p, homogeneous, is seen by another image at M p + facing s t, of which
// `maps` has M and t row by row. `shapes` has where each other image starts in `images`, its height and its width.
// Sums count the pixels of the image alone; `size` has their number, `mean` and `deviation` are those of its patches.
extern "C" __global__ void correlate(int height, int width, int planes, int others, double farthest,
                                     double nearest, double least,
                                     const float* __restrict__ grey, const float* __restrict__ size,
                                     const float* __restrict__ mean, const float* __restrict__ deviation,
                                     const float* __restrict__ facing, const float* __restrict__ s,
                                     const float* __restrict__ maps, const int* __restrict__ shapes,
                                     const float* __restrict__ images, float* __restrict__ scores) {
    __shared__ float own[ROWS * COLUMNS], seen[ROWS * COLUMNS], partial[3][ROWS * TILE_WIDTH];
    const int across = (width + TILE_WIDTH - 1) / TILE_WIDTH, down = (height + TILE_HEIGHT - 1) / TILE_HEIGHT;
    const int tile = blockIdx.x % (across * down), plane = blockIdx.x / (across * down);
    if (plane >= planes) return;
    const int top = tile / across * TILE_HEIGHT - HALO / 2, left = tile % across * TILE_WIDTH - HALO / 2;
    const float place = s[plane];
    for (int other = 0; other < others; ++other) {
        const float *map = maps + 12 * other, *image = images + shapes[3 * other];
        const int other_height = shapes[3 * other + 1], other_width = shapes[3 * other + 2];
        for (int i = threadIdx.x; i < ROWS * COLUMNS; i += blockDim.x) {
            const int row = top + i / COLUMNS, column = left + i % COLUMNS;
            own[i] = seen[i] = 0;
            if (row < 0 || column < 0 || row >= height || column >= width) continue;
            const float along = facing[row * width + column] * place;
            float point[3];
            for (int k = 0; k < 3; ++k) {
                const float* m = map + 4 * k;
                point[k] = m[0] * (column + 0.5f) + m[1] * (row + 0.5f) + m[2] + along * m[3];
            }
            const float nearer = 1 / fmaxf(point[2], 1e-6f);
            own[i] = grey[row * width + column];
            seen[i] = sample(image, other_height, other_width, point[0] * nearer, point[1] * nearer);
        }
        __syncthreads();
        for (int i = threadIdx.x; i < ROWS * TILE_WIDTH; i += blockDim.x) {
            const int first = i / TILE_WIDTH * COLUMNS + i % TILE_WIDTH;
            float sum = 0, squares = 0, products = 0;
#pragma unroll
            for (int k = 0; k < WINDOW; ++k) {
                const float value = seen[first + k];
                sum += value;
                squares += value * value;
                products += value * own[first + k];
            }
            partial[0][i] = sum;
            partial[1][i] = squares;
            partial[2][i] = products;
        }
        __syncthreads();
        for (int i = threadIdx.x; i < TILE_HEIGHT * TILE_WIDTH; i += blockDim.x) {
            const int row = top + HALO / 2 + i / TILE_WIDTH, column = left + HALO / 2 + i % TILE_WIDTH;
            if (row >= height || column >= width) continue;
            float sums[3] = {0, 0, 0};
            for (int t = 0; t < 3; ++t)
#pragma unroll
                for (int k = 0; k < WINDOW; ++k) sums[t] += partial[t][i + k * TILE_WIDTH];
            const int at = row * width + column;
            const float along = facing[at] * place, x = column + 0.5f, y = row + 0.5f;
            const float z = map[8] * x + map[9] * y + map[10] + along * map[11];
            const float u = map[0] * x + map[1] * y + map[2] + along * map[3];
            const float v = map[4] * x + map[5] * y + map[6] + along * map[7];
            const bool inside = along >= (float)farthest && along <= (float)nearest;
            const bool visible = inside && z > 1e-6f && u > 0 && v > 0 && u < z * other_width && v < z * other_height;
            const float average = sums[0] / size[at];
            const float variance = fmaxf(sums[1] / size[at] - average * average, (float)least);
            const float score = (sums[2] / size[at] - average * mean[at]) / (deviation[at] * sqrtf(variance));
            float* best = scores + (long long)plane * height * width + at;
            const float found = visible ? score : -1.0f;
            *best = other == 0 ? found : fmaxf(*best, found);
        }
        __syncthreads();
    }
}
"""


class Patches(NamedTuple):
    """An image whose patches are compared, float32 on a CUDA device ``[H, W]`` each."""

    grey: Tensor
    size: Tensor
    """Number of pixels of each patch that lie in the image."""
    mean: Tensor
    deviation: Tensor


def sweep_kernels(device: torch.device, window: int) -> dict[str, Launch]:
    """The kernel for a CUDA device and patches of ``window`` x ``window`` pixels, compiled on the first call.

    Raises:
        BackendError: the kernel cannot be compiled or loaded.
    """
    return load_kernels(SOURCE, ("correlate",), options(window), device, THREADS)


def options(window: int) -> tuple[str, ...]:
    """Compiler options of :data:`SOURCE`."""
    return f"-DWINDOW={window}", f"-DTILE_WIDTH={TILE_WIDTH}", f"-DTILE_HEIGHT={TILE_HEIGHT}"


def correlate(
    kernels: dict[str, Launch],
    patches: Patches,
    facing: Tensor,
    s: Tensor,
    others: Sequence[Tensor],
    maps: Tensor,
    inverses: tuple[float, float],
    least: float,
) -> Tensor:
    """Highest correlation of each patch with those of other images, by planes ``normal . X = 1 / s``: ``[S, H, W]``.

    It is -1 where no other image has the place, and where its inverse depth lies outside ``inverses``.

    Args:
        kernels: by :func:`sweep_kernels`.
        patches: of the image.
        facing: products of a normal with the points at depth 1 behind the middles of the pixels ``[H, W]``.
        s: inverse distances of the planes ``[S]``.
        others: grey values of one other image or more ``[H', W']`` each.
        maps: from a homogeneous pixel ``(x, y, 1)`` at infinity to a homogeneous one of another image, and the other's
            image of this camera, ``[len(others), 3, 4]``.
        inverses: lowest and highest inverse depth.
        least: least variance of a patch of another image.
    """
    height, width = facing.shape
    shapes, start = [], 0
    for image in others:
        shapes.append((start, *image.shape))
        start += image.numel()
    tiles = -(-height // TILE_HEIGHT) * -(-width // TILE_WIDTH)
    scores = facing.new_empty(len(s), height, width)
    kernels["correlate"](
        len(s) * tiles * THREADS,
        (
            *(height, width, len(s), len(others), *inverses, least),
            *(value.contiguous() for value in (*patches, facing, s, maps)),
            torch.tensor(shapes, dtype=torch.int32, device=facing.device),
            torch.cat([image.flatten() for image in others]),
            scores,
        ),
    )
    return scores
