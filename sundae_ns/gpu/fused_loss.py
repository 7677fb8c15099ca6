"""``(1 - weight) L1 + weight (1 - SSIM)`` of an image, L1 of its base colours, and gradients: one GPU kernel each.

Built from convolutions, SSIM reads and writes the image dozens of times. Here a block of threads keeps a tile of both
images in shared memory, and filters it there by rows and columns. It writes only three derivatives, which the backward
pass filters once more.

The source is plain C++ except for the thread indices, so the tests compile the same source for the CPU.
"""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from torch import Tensor

from sundae_ns.errors import DataError, SundaeError
from sundae_ns.gpu.nvrtc import Launch, load_kernels

SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window, pixels (Wang et al. 2004)."""

SIGMA = 1.5
"""Standard deviation of the window, pixels."""

TILE_WIDTH, TILE_HEIGHT = 32, 16
THREADS = 256

SOURCE = r"""
#define HALO (WINDOW - 1)
#define COLUMNS (TILE_WIDTH + HALO)
#define ROWS (TILE_HEIGHT + HALO)
#define C1 (0.01f * 0.01f)
#define C2 (0.03f * 0.03f)

static __device__ const float weights[WINDOW] = {WEIGHTS};

// Weighted sum over the rows of a window, after the filter along them.
__device__ __forceinline__ float filter_column(const float* partial) {
    float sum = 0;
#pragma unroll
    for (int k = 0; k < WINDOW; ++k) sum += weights[k] * partial[k * TILE_WIDTH];
    return sum;
}

// A block has one tile of the images. It sums the absolute differences of its pixels, 1 - SSIM of the windows whose
// first pixel it has, and the absolute differences of the base colours. If `derivatives` is given, it writes the
// derivatives of a window's SSIM with respect to its means of x, x x and x y, one plane for each and each channel.
extern "C" __global__ void compare(int height, int width, const float* __restrict__ image,
                                   const float* __restrict__ base, const float* __restrict__ target,
                                   double l1_weight, double ssim_weight, double base_weight,
                                   float* __restrict__ derivatives, float* __restrict__ losses,
                                   float* __restrict__ base_losses) {
    __shared__ float x[ROWS * COLUMNS], y[ROWS * COLUMNS], partial[5][ROWS * TILE_WIDTH], sums[3][THREADS];
    const int across = (width + TILE_WIDTH - 1) / TILE_WIDTH, tile = blockIdx.x;
    if (tile >= across * ((height + TILE_HEIGHT - 1) / TILE_HEIGHT)) return;
    const int top = tile / across * TILE_HEIGHT, left = tile % across * TILE_WIDTH, thread = threadIdx.x;
    const int windows_high = height - HALO, windows_wide = width - HALO;
    const long long plane = (long long)windows_high * windows_wide;
    float difference = 0, dissimilarity = 0, base_difference = 0;
    for (int c = 0; c < 3; ++c) {
        for (int i = thread; i < ROWS * COLUMNS; i += blockDim.x) {
            const int row = top + i / COLUMNS, column = left + i % COLUMNS;
            const bool inside = row < height && column < width;
            const long long at = ((long long)row * width + column) * 3 + c;
            x[i] = inside ? image[at] : 0;
            y[i] = inside ? target[at] : 0;
            if (i / COLUMNS >= TILE_HEIGHT || i % COLUMNS >= TILE_WIDTH) continue;
            difference += fabsf(x[i] - y[i]);
            if (base && inside) base_difference += fabsf(base[at] - y[i]);
        }
        __syncthreads();
        for (int i = thread; i < ROWS * TILE_WIDTH; i += blockDim.x) {
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
            partial[0][i] = mean_x;
            partial[1][i] = mean_y;
            partial[2][i] = xx;
            partial[3][i] = yy;
            partial[4][i] = xy;
        }
        __syncthreads();
        for (int i = thread; i < TILE_HEIGHT * TILE_WIDTH; i += blockDim.x) {
            const int row = top + i / TILE_WIDTH, column = left + i % TILE_WIDTH;
            if (row >= windows_high || column >= windows_wide) continue;
            const float mean_x = filter_column(partial[0] + i), mean_y = filter_column(partial[1] + i);
            const float both = mean_x * mean_y, squares = mean_x * mean_x + mean_y * mean_y;
            const float luminance = 2 * both + C1, structure = 2 * (filter_column(partial[4] + i) - both) + C2;
            const float luminance_max = squares + C1;
            const float structure_max = filter_column(partial[2] + i) + filter_column(partial[3] + i) - squares + C2;
            const float inverse = 1 / (luminance_max * structure_max), value = luminance * structure * inverse;
            dissimilarity += 1 - value;
            if (!derivatives) continue;
            float* derivative = derivatives + c * plane + (long long)row * windows_wide + column;
            // Covariances are means of products minus products of means, so a mean changes both.
            derivative[0] = 2 * (mean_y * (structure - luminance) * inverse +
                                 mean_x * value * (1 / structure_max - 1 / luminance_max));
            derivative[3 * plane] = -value / structure_max;
            derivative[6 * plane] = 2 * luminance * inverse;
        }
        __syncthreads();
    }
    sums[0][thread] = difference;
    sums[1][thread] = dissimilarity;
    sums[2][thread] = base_difference;
    __syncthreads();
    for (int half = blockDim.x / 2; half > 0; half /= 2) {
        if (thread < half)
            for (int s = 0; s < 3; ++s) sums[s][thread] += sums[s][thread + half];
        __syncthreads();
    }
    if (thread) return;
    losses[tile] = l1_weight * sums[0][0] + ssim_weight * sums[1][0];
    if (base) base_losses[tile] = base_weight * sums[2][0];
}

__device__ __forceinline__ float sign_of(float difference) {
    return difference > 0 ? 1.0f : difference < 0 ? -1.0f : difference;  // NaN stays NaN
}

// Gradients of both images, from the derivatives and from the gradients of the losses. A pixel is in the windows that
// begin up to HALO rows above and columns to the left of it.
extern "C" __global__ void compare_backward(int height, int width, const float* __restrict__ image,
                                            const float* __restrict__ base, const float* __restrict__ target,
                                            double l1_weight, double ssim_weight, double base_weight,
                                            const float* __restrict__ derivatives, const float* __restrict__ grad_loss,
                                            const float* __restrict__ grad_base_loss, float* __restrict__ grad_image,
                                            float* __restrict__ grad_base) {
    __shared__ float derivative[3][ROWS * COLUMNS], partial[3][ROWS * TILE_WIDTH];
    const int across = (width + TILE_WIDTH - 1) / TILE_WIDTH, tile = blockIdx.x;
    if (tile >= across * ((height + TILE_HEIGHT - 1) / TILE_HEIGHT)) return;
    const int top = tile / across * TILE_HEIGHT, left = tile % across * TILE_WIDTH;
    const int windows_high = height - HALO, windows_wide = width - HALO;
    const long long plane = (long long)windows_high * windows_wide;
    const float l1_gradient = grad_loss[0] * (float)l1_weight, ssim_gradient = -grad_loss[0] * (float)ssim_weight;
    const float base_gradient = base ? grad_base_loss[0] * (float)base_weight : 0;
    for (int c = 0; c < 3; ++c) {
        for (int i = threadIdx.x; i < ROWS * COLUMNS; i += blockDim.x) {
            const int row = top - HALO + i / COLUMNS, column = left - HALO + i % COLUMNS;
            const bool inside = row >= 0 && column >= 0 && row < windows_high && column < windows_wide;
            const long long at = c * plane + (long long)row * windows_wide + column;
            for (int s = 0; s < 3; ++s) derivative[s][i] = inside ? derivatives[at + 3 * s * plane] : 0;
        }
        __syncthreads();
        for (int i = threadIdx.x; i < ROWS * TILE_WIDTH; i += blockDim.x) {
            const int first = i / TILE_WIDTH * COLUMNS + i % TILE_WIDTH;
            for (int s = 0; s < 3; ++s) {
                float sum = 0;
#pragma unroll
                for (int k = 0; k < WINDOW; ++k) sum += weights[k] * derivative[s][first + k];  // window is symmetric
                partial[s][i] = sum;
            }
        }
        __syncthreads();
        for (int i = threadIdx.x; i < TILE_HEIGHT * TILE_WIDTH; i += blockDim.x) {
            const int row = top + i / TILE_WIDTH, column = left + i % TILE_WIDTH;
            if (row >= height || column >= width) continue;
            const long long at = ((long long)row * width + column) * 3 + c;
            const float a = image[at], b = target[at];
            const float filtered = filter_column(partial[0] + i) + 2 * a * filter_column(partial[1] + i) +
                                   b * filter_column(partial[2] + i);
            grad_image[at] = ssim_gradient * filtered + l1_gradient * sign_of(a - b);
            if (base) grad_base[at] = base_gradient * sign_of(base[at] - b);
        }
        __syncthreads();
    }
}
"""


_window = [math.exp(-((k - SSIM_WINDOW // 2) ** 2) / (2 * SIGMA**2)) for k in range(SSIM_WINDOW)]
_WEIGHTS = ",".join(f"{weight / sum(_window):.9e}f" for weight in _window)

OPTIONS = (
    f"-DWINDOW={SSIM_WINDOW}",
    f"-DTILE_WIDTH={TILE_WIDTH}",
    f"-DTILE_HEIGHT={TILE_HEIGHT}",
    f"-DTHREADS={THREADS}",
    f"-DWEIGHTS={_WEIGHTS}",
)
"""Compiler options of :data:`SOURCE`."""


def loss_kernels(device: torch.device) -> dict[str, Launch]:
    """The kernels for a CUDA device, compiled on the first call.

    Raises:
        BackendError: the kernels cannot be compiled or loaded.
    """
    return load_kernels(SOURCE, ("compare", "compare_backward"), OPTIONS, device, THREADS)


def fused_loss(
    image: Tensor,
    target: Tensor,
    weight: float,
    base: Tensor | None = None,
    l1_weight: float | None = None,
) -> tuple[Tensor, Tensor | None]:
    """``(1 - weight) L1 + weight (1 - SSIM)`` of an image, and L1 of its base colours; differentiable scalars.

    L1 is the mean over all values. SSIM is pytorch_msssim's, over windows inside the image, with a data range of 1.

    Args:
        image: float32 on a CUDA device ``[H, W, 3]``, both sides at least :data:`SSIM_WINDOW`.
        target: target image, as ``image``; gets no gradient.
        weight: weight of 1 - SSIM, in [0, 1].
        base: base colours to compare with the target, as ``image``, or None.
        l1_weight: weight of L1; None for ``1 - weight``.

    Returns:
        The loss, and the L1 of ``base`` or None; float32 ``[]`` each.

    Raises:
        BackendError: the kernels cannot be compiled or loaded.
        DataError: the images differ in shape, are too small, or are not float32.
    """
    for each in (image,) if base is None else (image, base):
        same_kind = each.shape == target.shape and each.dtype == target.dtype == torch.float32
        if not same_kind or each.shape[2:] != (3,) or min(each.shape[:2]) < SSIM_WINDOW:
            raise DataError(
                f"the fused loss cannot compare {each.dtype} {list(each.shape)} with {target.dtype} "
                f"{list(target.shape)}; pass float32 [H, W, 3] of one size, at least {SSIM_WINDOW} px per side"
            )
    weights = (1 - weight if l1_weight is None else l1_weight, weight)
    return cast("tuple[Tensor, Tensor | None]", _Loss.apply(image, base, target.detach(), weights))


def _threads(image: Tensor) -> int:
    """Number of threads: one block per tile."""
    height, width = image.shape[:2]
    return -(-width // TILE_WIDTH) * -(-height // TILE_HEIGHT) * THREADS


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, image: Tensor, base: Tensor | None, target: Tensor, weights: tuple[float, float]
    ) -> tuple[Tensor, Tensor | None]:
        image, target = image.contiguous(), target.contiguous()
        base = None if base is None else base.contiguous()
        height, width, channels = image.shape
        windows = (height - SSIM_WINDOW + 1) * (width - SSIM_WINDOW + 1) * channels
        derivatives = image.new_empty(3 * windows) if any(ctx.needs_input_grad) else None
        losses = image.new_empty(_threads(image) // THREADS)
        base_losses = None if base is None else torch.empty_like(losses)
        scales = (weights[0] / image.numel(), weights[1] / windows, 1 / image.numel())
        arguments = [height, width, image, base, target, *scales, derivatives, losses, base_losses]
        loss_kernels(image.device)["compare"](_threads(image), arguments)
        ctx.save_for_backward(image, base, target, derivatives)
        ctx.scales = scales
        return losses.sum(), None if base_losses is None else base_losses.sum()

    @staticmethod
    def backward(  # type: ignore[override]
        ctx: Any, grad_loss: Tensor, grad_base_loss: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True: the kernel would be missing from that graph
            raise SundaeError(
                "the fused loss has no second derivative; use float64 images, whose loss is computed by convolutions"
            )
        image, base, target, derivatives = ctx.saved_tensors
        grad_image, grad_base = torch.empty_like(image), None if base is None else torch.empty_like(base)
        height, width, _ = image.shape
        arguments = [height, width, image, base, target, *ctx.scales, derivatives, grad_loss, grad_base_loss]
        loss_kernels(image.device)["compare_backward"](_threads(image), [*arguments, grad_image, grad_base])
        return grad_image, grad_base, None, None
