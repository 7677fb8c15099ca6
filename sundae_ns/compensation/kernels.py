"""CUDA source of what lies between the head's convolutions, forwards and backwards, and the calls that start it.

Run layer by layer, most of the head's time goes into reading and writing pictures: a bias, an activation, a pooling, an
upsampling and a concatenation are a pass each. Here a pass does all that happens between two convolutions, and writes its
result where the next one reads it.

The source is plain C++ apart from the few words by which a thread finds its number, so that the tests run the very same
lines on a CPU.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import torch

from sundae_ns.compensation.unet import SLOPE, UNet
from sundae_ns.gpu.nvrtc import Kernel, Launch

PACK = 8
"""Channels that a thread moves at once, 16 bytes of them; pictures are padded to a multiple, which tensor cores want too."""

FORWARD = ("fold", "activate", "pool", "upsample", "unfold")
"""Kernels of :data:`SOURCE` that make a picture."""

BACKWARD = tuple(f"{name}_backward" for name in FORWARD)
"""Those of their gradients."""

_CONVERSIONS = {
    torch.float16: r"""
typedef unsigned short T;
__device__ __forceinline__ float load(T v) { float f; asm("cvt.f32.f16 %0, %1;" : "=f"(f) : "h"(v)); return f; }
__device__ __forceinline__ T store(float f) { T v; asm("cvt.rn.f16.f32 %0, %1;" : "=h"(v) : "f"(f)); return v; }
""",
    torch.bfloat16: r"""
typedef unsigned short T;
__device__ __forceinline__ float load(T v) { return __uint_as_float((unsigned)v << 16); }
__device__ __forceinline__ T store(float f) { T v; asm("cvt.rn.bf16.f32 %0, %1;" : "=h"(v) : "f"(f)); return v; }
""",
}

SOURCE = r"""
struct __align__(PACK * sizeof(T)) Pack { T v[PACK]; };

// All pictures are channels last: [height, width, channels]. A thread has one pack of channels of one pixel.

__device__ __forceinline__ float leaky(float x) { return x > 0.0f ? x : SLOPE * x; }

__device__ __forceinline__ T activated(T x, float bias) { return store(leaky(load(x) + bias)); }

// Casts what was splatted, puts it side by side, pads it by zeros at the bottom, to the right and in channels, and folds
// blocks of R x R pixels into channels: channel c of pixel (dy, dx) of a block becomes channel (c R + dy) R + dx.
extern "C" __global__ void fold(const float* __restrict__ splatted, int splatted_stride,
                                const float* __restrict__ alpha, int alpha_stride, int num_colors, int num_features,
                                int padded, int height, int width, int rows, int columns, T* __restrict__ out) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)rows * columns * padded) return;
    const int c = (int)(i % padded);
    const long long block = i / padded;
    const int x = (int)(block % columns), y = (int)(block / columns);
    const bool is_alpha = c < num_colors && c == 3;
    const float* from = is_alpha ? alpha : splatted + (c < num_colors ? c : c - num_colors + 3);
    const int stride = is_alpha ? alpha_stride : splatted_stride;
    T* to = out + i * (R * R);
    for (int dy = 0; dy < R; ++dy)
        for (int dx = 0; dx < R; ++dx) {
            const int row = y * R + dy, column = x * R + dx;
            const bool inside = row < height && column < width && c < num_colors + num_features;
            to[dy * R + dx] = store(inside ? from[((long long)row * width + column) * stride] : 0.0f);
        }
}

// Adds the bias and activates, in place.
extern "C" __global__ void activate(T* x, const float* __restrict__ bias, int channels, int pixels) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    const int packs = channels / PACK;
    if (i >= (long long)pixels * packs) return;
    const int c = (int)(i % packs) * PACK;
    Pack pack = ((Pack*)x)[i];
#pragma unroll
    for (int k = 0; k < PACK; ++k) pack.v[k] = activated(pack.v[k], bias[c + k]);
    ((Pack*)x)[i] = pack;
}

// The same, of 2 x 2 pixels, into the last channels of a picture that is wider in channels; and their mean.
extern "C" __global__ void pool(const T* __restrict__ x, const float* __restrict__ bias, int channels, int rows,
                                int columns, T* __restrict__ wide, int wide_channels, T* __restrict__ pooled) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    const int packs = channels / PACK;
    if (i >= (long long)(rows / 2) * (columns / 2) * packs) return;
    const int c = (int)(i % packs) * PACK;
    const long long coarse = i / packs;
    const int column = (int)(coarse % (columns / 2)) * 2, row = (int)(coarse / (columns / 2)) * 2;
    float sum[PACK] = {};
    for (int dy = 0; dy < 2; ++dy)
        for (int dx = 0; dx < 2; ++dx) {
            const long long pixel = (long long)(row + dy) * columns + column + dx;
            Pack pack = *(const Pack*)(x + pixel * channels + c);
#pragma unroll
            for (int k = 0; k < PACK; ++k) {
                pack.v[k] = activated(pack.v[k], bias[c + k]);
                sum[k] += load(pack.v[k]);
            }
            *(Pack*)(wide + pixel * wide_channels + (wide_channels - channels) + c) = pack;
        }
    Pack mean;
#pragma unroll
    for (int k = 0; k < PACK; ++k) mean.v[k] = store(0.25f * sum[k]);
    ((Pack*)pooled)[i] = mean;
}

// Adds the bias, activates, doubles the size bilinearly (pixels are areas), and writes into the first channels of a wider
// picture. A fine pixel lies a quarter of a pixel from the centre of the coarse one that it is in.
extern "C" __global__ void upsample(const T* __restrict__ x, const float* __restrict__ bias, int channels, int rows,
                                    int columns, T* __restrict__ wide, int wide_channels) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    const int packs = channels / PACK;
    if (i >= 4LL * rows * columns * packs) return;
    const int c = (int)(i % packs) * PACK;
    const long long fine = i / packs;
    const int column = (int)(fine % (2 * columns)), row = (int)(fine / (2 * columns));
    const int near_y = row / 2, far_y = near_y + (row % 2 ? 1 : -1);
    const int near_x = column / 2, far_x = near_x + (column % 2 ? 1 : -1);
    const int ys[2] = {near_y, far_y < 0 ? 0 : far_y >= rows ? rows - 1 : far_y};
    const int xs[2] = {near_x, far_x < 0 ? 0 : far_x >= columns ? columns - 1 : far_x};
    float sum[PACK] = {};
    for (int a = 0; a < 2; ++a)
        for (int b = 0; b < 2; ++b) {
            const float weight = (a ? 0.25f : 0.75f) * (b ? 0.25f : 0.75f);
            const Pack pack = *(const Pack*)(x + ((long long)ys[a] * columns + xs[b]) * channels + c);
#pragma unroll
            for (int k = 0; k < PACK; ++k) sum[k] += weight * load(activated(pack.v[k], bias[c + k]));
        }
    Pack pack;
#pragma unroll
    for (int k = 0; k < PACK; ++k) pack.v[k] = store(sum[k]);
    *(Pack*)(wide + fine * wide_channels + c) = pack;
}

// Adds the bias, activates, takes the last, 1 x 1 convolution, unfolds blocks, crops, and adds the correction.
extern "C" __global__ void unfold(const T* __restrict__ x, const float* __restrict__ bias,
                                  const float* __restrict__ weight, const float* __restrict__ out_bias, int rows,
                                  int columns, const float* __restrict__ base, const float* __restrict__ alpha,
                                  int alpha_stride, int height, int width, float* __restrict__ out) {
    __shared__ float w[3 * R * R * WIDTH];
    for (int k = threadIdx.x; k < 3 * R * R * WIDTH; k += blockDim.x) w[k] = weight[k];
    __syncthreads();
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)rows * columns) return;
    float sum[3 * R * R];
#pragma unroll
    for (int o = 0; o < 3 * R * R; ++o) sum[o] = out_bias[o];
    for (int c = 0; c < WIDTH; c += PACK) {
        const Pack pack = *(const Pack*)(x + i * WIDTH + c);
#pragma unroll
        for (int k = 0; k < PACK; ++k) {
            const float value = load(activated(pack.v[k], bias[c + k]));
#pragma unroll
            for (int o = 0; o < 3 * R * R; ++o) sum[o] += w[o * WIDTH + c + k] * value;
        }
    }
    const int column = (int)(i % columns) * R, row = (int)(i / columns) * R;
#pragma unroll
    for (int o = 0; o < 3 * R * R; ++o) {
        const int c = o / (R * R), y = row + o / R % R, x = column + o % R;
        if (y >= height || x >= width) continue;
        const long long pixel = (long long)y * width + x;
        // What overflowed on the way corrects nothing.
        const float value = sum[o] - sum[o] == 0.0f ? sum[o] : 0.0f;
        out[3 * pixel + c] = RESIDUAL ? base[3 * pixel + c] + alpha[pixel * alpha_stride] * value : value;
    }
}

// Gradients. Below zero an activation keeps its sign, so that it tells its slope as well as what it was made from.

__device__ __forceinline__ float sloped(float gradient, float at) { return at > 0.0f ? gradient : SLOPE * gradient; }

// Of the unfolded picture, with respect to what was convolved last; and of each pixel's three values before they were
// weighted by accumulation, and the last activations, from which the last convolution's weights get theirs.
extern "C" __global__ void unfold_backward(const T* __restrict__ x, const float* __restrict__ bias,
                                           const float* __restrict__ weight, const float* __restrict__ out_bias,
                                           int rows, int columns, const float* __restrict__ gradient,
                                           const float* __restrict__ alpha, int alpha_stride, int height, int width,
                                           T* __restrict__ to_x, T* __restrict__ values, T* __restrict__ to_values,
                                           float* __restrict__ to_alpha) {
    __shared__ float w[3 * R * R * WIDTH];
    for (int k = threadIdx.x; k < 3 * R * R * WIDTH; k += blockDim.x) w[k] = weight[k];
    __syncthreads();
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)rows * columns) return;
    const int column = (int)(i % columns) * R, row = (int)(i / columns) * R;
    float sum[3 * R * R], to_sum[3 * R * R];
#pragma unroll
    for (int o = 0; o < 3 * R * R; ++o) {
        const int c = o / (R * R), y = row + o / R % R, x_ = column + o % R;
        const long long pixel = (long long)y * width + x_;
        const bool inside = y < height && x_ < width;
        sum[o] = out_bias[o];
        to_sum[o] = inside ? gradient[3 * pixel + c] * (RESIDUAL ? alpha[pixel * alpha_stride] : 1.0f) : 0.0f;
        to_values[i * (3 * R * R) + o] = store(to_sum[o]);
    }
    for (int c = 0; c < WIDTH; c += PACK) {
        Pack pack = *(const Pack*)(x + i * WIDTH + c), to;
#pragma unroll
        for (int k = 0; k < PACK; ++k) {
            pack.v[k] = activated(pack.v[k], bias[c + k]);
            const float value = load(pack.v[k]);
            float total = 0.0f;
#pragma unroll
            for (int o = 0; o < 3 * R * R; ++o) {
                const float factor = w[o * WIDTH + c + k];
                sum[o] += factor * value;
                total += factor * to_sum[o];
            }
            to.v[k] = store(sloped(total, value));
        }
        *(Pack*)(to_x + i * WIDTH + c) = to;
        *(Pack*)(values + i * WIDTH + c) = pack;
    }
    if (!RESIDUAL) return;
    for (int dy = 0; dy < R; ++dy)
        for (int dx = 0; dx < R; ++dx) {
            const int y = row + dy, x_ = column + dx;
            if (y >= height || x_ >= width) continue;
            const long long pixel = (long long)y * width + x_;
            float total = 0.0f;
#pragma unroll
            for (int c = 0; c < 3; ++c) total += gradient[3 * pixel + c] * sum[(c * R + dy) * R + dx];
            to_alpha[pixel] = total;
        }
}

// Of activations, in place.
extern "C" __global__ void activate_backward(T* gradient, const T* __restrict__ activations, int channels, int pixels) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)pixels * (channels / PACK)) return;
    Pack pack = ((Pack*)gradient)[i];
    const Pack at = ((const Pack*)activations)[i];
#pragma unroll
    for (int k = 0; k < PACK; ++k) pack.v[k] = store(sloped(load(pack.v[k]), load(at.v[k])));
    ((Pack*)gradient)[i] = pack;
}

// Of a skip connection and of the mean, with respect to what was convolved.
extern "C" __global__ void pool_backward(const T* __restrict__ to_wide, const T* __restrict__ wide, int wide_channels,
                                         const T* __restrict__ to_pooled, int channels, int rows, int columns,
                                         T* __restrict__ to_x) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    const int packs = channels / PACK;
    if (i >= (long long)rows * columns * packs) return;
    const int c = (int)(i % packs) * PACK;
    const long long pixel = i / packs;
    const int column = (int)(pixel % columns), row = (int)(pixel / columns);
    const long long at = pixel * wide_channels + (wide_channels - channels) + c;
    const Pack direct = *(const Pack*)(to_wide + at), activations = *(const Pack*)(wide + at);
    const long long coarse = (long long)(row / 2) * (columns / 2) + column / 2;
    const Pack mean = *(const Pack*)(to_pooled + coarse * channels + c);
    Pack to;
#pragma unroll
    for (int k = 0; k < PACK; ++k)
        to.v[k] = store(sloped(load(direct.v[k]) + 0.25f * load(mean.v[k]), load(activations.v[k])));
    ((Pack*)to_x)[i] = to;
}

// Of the doubled picture, with respect to what was convolved: the same weights, gathered. At a border the last pixel
// stands in for those beyond it.
extern "C" __global__ void upsample_backward(const T* __restrict__ to_wide, int wide_channels,
                                             const T* __restrict__ x, const float* __restrict__ bias, int channels,
                                             int rows, int columns, T* __restrict__ to_x) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    const int packs = channels / PACK;
    if (i >= (long long)rows * columns * packs) return;
    const int c = (int)(i % packs) * PACK;
    const long long pixel = i / packs;
    const int column = (int)(pixel % columns), row = (int)(pixel / columns);
    float sum[PACK] = {};
    for (int a = -1; a < 3; ++a)
        for (int b = -1; b < 3; ++b) {
            const int y = 2 * row + a, x_ = 2 * column + b;
            const int fine_y = y < 0 ? 0 : y >= 2 * rows ? 2 * rows - 1 : y;
            const int fine_x = x_ < 0 ? 0 : x_ >= 2 * columns ? 2 * columns - 1 : x_;
            const float weight = (a == 0 || a == 1 ? 0.75f : 0.25f) * (b == 0 || b == 1 ? 0.75f : 0.25f);
            const Pack pack = *(const Pack*)(to_wide + ((long long)fine_y * 2 * columns + fine_x) * wide_channels + c);
#pragma unroll
            for (int k = 0; k < PACK; ++k) sum[k] += weight * load(pack.v[k]);
        }
    const Pack pack = ((const Pack*)x)[i];
    Pack to;
#pragma unroll
    for (int k = 0; k < PACK; ++k) to.v[k] = store(sloped(sum[k], load(pack.v[k]) + bias[c + k]));
    ((Pack*)to_x)[i] = to;
}

// Of the folded picture, with respect to what was splatted; that of accumulation is added to what is there.
extern "C" __global__ void fold_backward(const T* __restrict__ to_folded, int num_colors, int num_features, int padded,
                                         int height, int width, int rows, int columns, float* __restrict__ to_splatted,
                                         float* __restrict__ to_alpha) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)rows * columns * padded) return;
    const int c = (int)(i % padded);
    if (c >= num_colors + num_features) return;
    const long long block = i / padded;
    const int x = (int)(block % columns), y = (int)(block / columns);
    const T* from = to_folded + i * (R * R);
    for (int dy = 0; dy < R; ++dy)
        for (int dx = 0; dx < R; ++dx) {
            const int row = y * R + dy, column = x * R + dx;
            if (row >= height || column >= width) continue;
            const long long pixel = (long long)row * width + column;
            const float value = load(from[dy * R + dx]);
            if (c < num_colors && c == 3)
                to_alpha[pixel] += value;
            else
                to_splatted[pixel * (3 + num_features) + (c < num_colors ? c : c - num_colors + 3)] = value;
        }
}
"""

Launches = Mapping[str, Launch]
"""By the kernel's name."""


def program(dtype: torch.dtype) -> str:
    """The source for pictures of a dtype, with what it leaves open apart from :func:`definitions`."""
    return _CONVERSIONS[dtype] + SOURCE


def definitions(net: UNet, residual: bool) -> tuple[str, ...]:
    """Compiler options for a network: its folding and its width, and whether it corrects a picture."""
    return (
        f"-DR={net.pixel_unshuffle}",
        f"-DWIDTH={net.out.in_channels}",
        f"-DPACK={PACK}",
        f"-DSLOPE={SLOPE}f",
        f"-DRESIDUAL={int(residual)}",
    )


@functools.cache
def compiled(
    device: torch.device, dtype: torch.dtype, options: tuple[str, ...], names: tuple[str, ...] = FORWARD
) -> Launches:
    """The kernels for a device, compiled once.

    Args:
        device: a CUDA device.
        dtype: of pictures between the convolutions, float16 or bfloat16.
        options: see :func:`definitions`.
        names: which of them.

    Raises:
        BackendError: they cannot be compiled or loaded here.
    """
    return {name: Kernel(program(dtype), name, device, options) for name in names}
