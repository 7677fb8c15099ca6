"""``lambda_1 L1 + lambda_2 (1 - SSIM)`` of a picture, L1 of another beside it, and their gradients: one kernel each, on a GPU.

Made of convolutions, SSIM takes dozens of passes over the picture. Here a block of threads keeps a tile of both pictures in
shared memory, filters it there by columns and by rows, and leaves only the three slopes that the way back filters once more.

The source is plain C++ apart from the few words by which a thread finds its number, so that the tests run the very same
lines on a CPU.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from sundae_ns.errors import DataError, SundaeError
from sundae_ns.gpu.nvrtc import Kernel, Launch

WINDOW = 11
"""Side of SSIM's Gaussian window, pixels (Wang et al. 2004)."""

SIGMA = 1.5
"""Its standard deviation, pixels."""

TILE_WIDTH, TILE_HEIGHT = 32, 16
THREADS = 256

SOURCE = r"""
#define HALO (WINDOW - 1)
#define COLUMNS (TILE_WIDTH + HALO)
#define ROWS (TILE_HEIGHT + HALO)
#define C1 (0.01f * 0.01f)
#define C2 (0.03f * 0.03f)

static __device__ const float weights[WINDOW] = {WEIGHTS};

// Sum over a window's rows of what was filtered along them.
__device__ __forceinline__ float down(const float* along) {
    float sum = 0;
#pragma unroll
    for (int k = 0; k < WINDOW; ++k) sum += weights[k] * along[k * TILE_WIDTH];
    return sum;
}

// A block has one tile of the pictures. Its share of the loss comes from the sum of absolute differences of its pixels, and
// that of 1 - SSIM over the windows whose first pixel it has; its share of the base's loss from differences alone. With
// slopes: derivatives of a window's SSIM by the means of x, x x and x y in it, a plane for each and each channel.
extern "C" __global__ void compare(int height, int width, const float* __restrict__ picture,
                                   const float* __restrict__ base, const float* __restrict__ target,
                                   double of_difference, double of_dissimilarity, double of_base,
                                   float* __restrict__ slopes, float* __restrict__ shares,
                                   float* __restrict__ base_shares) {
    __shared__ float x[ROWS * COLUMNS], y[ROWS * COLUMNS], along[5][ROWS * TILE_WIDTH], found[3][THREADS];
    const int across = (width + TILE_WIDTH - 1) / TILE_WIDTH, tile = blockIdx.x;
    if (tile >= across * ((height + TILE_HEIGHT - 1) / TILE_HEIGHT)) return;
    const int top = tile / across * TILE_HEIGHT, left = tile % across * TILE_WIDTH, me = threadIdx.x;
    const int windows_high = height - HALO, windows_wide = width - HALO;
    const long long plane = (long long)windows_high * windows_wide;
    float difference = 0, dissimilarity = 0, beside = 0;
    for (int c = 0; c < 3; ++c) {
        for (int i = me; i < ROWS * COLUMNS; i += blockDim.x) {
            const int row = top + i / COLUMNS, column = left + i % COLUMNS;
            const bool inside = row < height && column < width;
            const long long at = ((long long)row * width + column) * 3 + c;
            x[i] = inside ? picture[at] : 0;
            y[i] = inside ? target[at] : 0;
            if (i / COLUMNS >= TILE_HEIGHT || i % COLUMNS >= TILE_WIDTH) continue;
            difference += fabsf(x[i] - y[i]);
            if (base && inside) beside += fabsf(base[at] - y[i]);
        }
        __syncthreads();
        for (int i = me; i < ROWS * TILE_WIDTH; i += blockDim.x) {
            const int first = i / TILE_WIDTH * COLUMNS + i % TILE_WIDTH;
            float mean_x = 0, mean_y = 0, xx = 0, yy = 0, xy = 0;
#pragma unroll
            for (int k = 0; k < WINDOW; ++k) {
                const float a = x[first + k], b = y[first + k], w = weights[k];
                mean_x += w * a;
                mean_y += w * b;
                xx += w * a * a;
                yy += w * b * b;
                xy += w * a * b;
            }
            along[0][i] = mean_x;
            along[1][i] = mean_y;
            along[2][i] = xx;
            along[3][i] = yy;
            along[4][i] = xy;
        }
        __syncthreads();
        for (int i = me; i < TILE_HEIGHT * TILE_WIDTH; i += blockDim.x) {
            const int row = top + i / TILE_WIDTH, column = left + i % TILE_WIDTH;
            if (row >= windows_high || column >= windows_wide) continue;
            const float mean_x = down(along[0] + i), mean_y = down(along[1] + i);
            const float both = mean_x * mean_y, squares = mean_x * mean_x + mean_y * mean_y;
            const float light = 2 * both + C1, shape = 2 * (down(along[4] + i) - both) + C2;
            const float light_most = squares + C1, shape_most = down(along[2] + i) + down(along[3] + i) - squares + C2;
            const float least = 1 / (light_most * shape_most), value = light * shape * least;
            dissimilarity += 1 - value;
            if (!slopes) continue;
            float* slope = slopes + c * plane + (long long)row * windows_wide + column;
            // Covariances are means of products less products of means: a mean moves both.
            slope[0] = 2 * (mean_y * (shape - light) * least + mean_x * value * (1 / shape_most - 1 / light_most));
            slope[3 * plane] = -value / shape_most;
            slope[6 * plane] = 2 * light * least;
        }
        __syncthreads();
    }
    found[0][me] = difference;
    found[1][me] = dissimilarity;
    found[2][me] = beside;
    __syncthreads();
    for (int half = blockDim.x / 2; half > 0; half /= 2) {
        if (me < half)
            for (int s = 0; s < 3; ++s) found[s][me] += found[s][me + half];
        __syncthreads();
    }
    if (me) return;
    shares[tile] = of_difference * found[0][0] + of_dissimilarity * found[1][0];
    if (base) base_shares[tile] = of_base * found[2][0];
}

__device__ __forceinline__ float sign_of(float difference) {
    return difference > 0 ? 1.0f : difference < 0 ? -1.0f : difference;  // NaN stays NaN
}

// The gradients with respect to both pictures, from slopes and what the sums count for. A pixel is in the windows that begin
// up to HALO rows above and columns to the left of it.
extern "C" __global__ void compare_backward(int height, int width, const float* __restrict__ picture,
                                            const float* __restrict__ base, const float* __restrict__ target,
                                            double of_difference, double of_dissimilarity, double of_base,
                                            const float* __restrict__ slopes, const float* __restrict__ to_loss,
                                            const float* __restrict__ to_base_loss, float* __restrict__ to_picture,
                                            float* __restrict__ to_base) {
    __shared__ float slope[3][ROWS * COLUMNS], along[3][ROWS * TILE_WIDTH];
    const int across = (width + TILE_WIDTH - 1) / TILE_WIDTH, tile = blockIdx.x;
    if (tile >= across * ((height + TILE_HEIGHT - 1) / TILE_HEIGHT)) return;
    const int top = tile / across * TILE_HEIGHT, left = tile % across * TILE_WIDTH;
    const int windows_high = height - HALO, windows_wide = width - HALO;
    const long long plane = (long long)windows_high * windows_wide;
    const float to_difference = to_loss[0] * (float)of_difference, to_similarity = -to_loss[0] * (float)of_dissimilarity;
    const float beside = base ? to_base_loss[0] * (float)of_base : 0;
    for (int c = 0; c < 3; ++c) {
        for (int i = threadIdx.x; i < ROWS * COLUMNS; i += blockDim.x) {
            const int row = top - HALO + i / COLUMNS, column = left - HALO + i % COLUMNS;
            const bool inside = row >= 0 && column >= 0 && row < windows_high && column < windows_wide;
            const long long at = c * plane + (long long)row * windows_wide + column;
            for (int s = 0; s < 3; ++s) slope[s][i] = inside ? slopes[at + 3 * s * plane] : 0;
        }
        __syncthreads();
        for (int i = threadIdx.x; i < ROWS * TILE_WIDTH; i += blockDim.x) {
            const int first = i / TILE_WIDTH * COLUMNS + i % TILE_WIDTH;
            for (int s = 0; s < 3; ++s) {
                float sum = 0;
#pragma unroll
                for (int k = 0; k < WINDOW; ++k) sum += weights[k] * slope[s][first + k];  // its mirror image is itself
                along[s][i] = sum;
            }
        }
        __syncthreads();
        for (int i = threadIdx.x; i < TILE_HEIGHT * TILE_WIDTH; i += blockDim.x) {
            const int row = top + i / TILE_WIDTH, column = left + i % TILE_WIDTH;
            if (row >= height || column >= width) continue;
            const long long at = ((long long)row * width + column) * 3 + c;
            const float a = picture[at], b = target[at];
            const float filtered = down(along[0] + i) + 2 * a * down(along[1] + i) + b * down(along[2] + i);
            to_picture[at] = to_similarity * filtered + to_difference * sign_of(a - b);
            if (base) to_base[at] = beside * sign_of(base[at] - b);
        }
        __syncthreads();
    }
}
"""


class Launches(NamedTuple):
    """The kernels, on one device."""

    compare: Launch
    compare_backward: Launch


def definitions() -> tuple[str, ...]:
    """Options of the compiler that :data:`SOURCE` needs."""
    window = [math.exp(-((k - WINDOW // 2) ** 2) / (2 * SIGMA**2)) for k in range(WINDOW)]
    weights = ",".join(f"{w / sum(window):.9e}f" for w in window)
    sizes = (f"-D{name}={globals()[name]}" for name in ("WINDOW", "TILE_WIDTH", "TILE_HEIGHT", "THREADS"))
    return (*sizes, f"-DWEIGHTS={weights}")


@functools.cache
def compiled(device: torch.device) -> Launches:
    """The kernels for a CUDA device, compiled once.

    Raises:
        BackendError: they cannot be compiled or loaded here.
    """
    return Launches(*(Kernel(SOURCE, name, device, definitions(), THREADS) for name in Launches._fields))


def fused_loss(
    picture: Tensor, target: Tensor, weight: float, base: Tensor | None = None, launches: Launches | None = None
) -> tuple[Tensor, Tensor | None]:
    """``(1 - weight) L1 + weight (1 - SSIM)`` of a picture, and L1 of its base colours: two scalars with gradients for them.

    L1 is the mean over all values; SSIM pytorch_msssim's, with windows that lie inside of the picture and a data range of 1.

    Args:
        picture: float32 on a CUDA device ``[H, W, 3]``, both sides of at least :data:`WINDOW`.
        target: likewise; no gradient reaches it.
        weight: in [0, 1].
        base: another picture to compare with the target, likewise; None for none.
        launches: kernels to take in place of those that are compiled for the device.

    Returns:
        The loss, and that of the base, None without one; float32 ``[]`` each.

    Raises:
        BackendError: the kernels cannot be compiled or loaded here.
        DataError: the pictures are not of one such shape, or not float32.
    """
    for one in (picture,) if base is None else (picture, base):
        alike = one.shape == target.shape and one.dtype == target.dtype == torch.float32
        if not alike or one.shape[2:] != (3,) or min(one.shape[:2]) < WINDOW:
            raise DataError(
                f"a loss of {one.dtype} {list(one.shape)} against {target.dtype} {list(target.shape)}; "
                f"give float32 [H, W, 3] of one size, {WINDOW} px or more a side"
            )
    launches = compiled(picture.device) if launches is None else launches
    return cast("tuple[Tensor, Tensor | None]", _Loss.apply(picture, base, target.detach(), weight, launches))


def _threads(picture: Tensor) -> int:
    """A block for each tile."""
    height, width = picture.shape[:2]
    return -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT) * THREADS


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, picture: Tensor, base: Tensor | None, target: Tensor, weight: float, launches: Launches
    ) -> tuple[Tensor, Tensor | None]:
        picture, target = picture.contiguous(), target.contiguous()
        base = None if base is None else base.contiguous()
        height, width, channels = picture.shape
        windows = (height - WINDOW + 1) * (width - WINDOW + 1) * channels
        slopes = picture.new_empty(3 * windows) if any(ctx.needs_input_grad) else None
        shares = picture.new_empty(_threads(picture) // THREADS)
        base_shares = None if base is None else torch.empty_like(shares)
        worth = ((1 - weight) / picture.numel(), weight / windows, 1 / picture.numel())
        arguments = [height, width, picture, base, target, *worth, slopes, shares, base_shares]
        launches.compare(_threads(picture), arguments)
        ctx.save_for_backward(picture, base, target, slopes)
        ctx.launches, ctx.worth = launches, worth
        return shares.sum(), None if base_shares is None else base_shares.sum()

    @staticmethod
    def backward(  # type: ignore[override]
        ctx: Any, to_loss: Tensor, to_base_loss: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # a graph of this pass is wanted, and would lack it
            raise SundaeError(
                "the kernel of the loss has no second derivative; take that of float64 pictures, which are convolved"
            )
        picture, base, target, slopes = ctx.saved_tensors
        to_picture, to_base = torch.empty_like(picture), None if base is None else torch.empty_like(base)
        height, width, _ = picture.shape
        arguments = [height, width, picture, base, target, *ctx.worth, slopes, to_loss, to_base_loss]
        ctx.launches.compare_backward(_threads(picture), [*arguments, to_picture, to_base])
        return to_picture, to_base, None, None, None
