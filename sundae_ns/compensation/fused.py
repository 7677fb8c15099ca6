"""The U-Net for pictures that are only looked at: convolutions by cuDNN, and all that lies between them in a few kernels.

Run layer by layer, most of the time goes into reading and writing pictures: a bias, an activation, a pooling, an upsampling
and a concatenation are a pass each. Here a pass does all that happens between two convolutions, and writes its result where
the next one reads it. The whole is recorded as one CUDA graph for each picture size that stays.

The source of the kernels is plain C++ apart from the few words by which a thread finds its number, so that the tests run
the very same lines on a CPU.
"""

from __future__ import annotations

import functools
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sundae_ns.compensation.unet import SLOPE, UNet
from sundae_ns.nvrtc import Kernel

PACK = 8
"""Channels that a thread moves at once, 16 bytes of them; pictures are padded to a multiple, which tensor cores want too."""

MAX_SIZES = 4
"""Recordings kept at a time: each holds its own activations."""

RECORD_AT = 3
"""A size is recorded when it is shown for this time in a row: a viewer that is being resized never shows one twice."""

KERNELS = ("fold", "activate", "pool", "upsample", "unfold")
"""Names of the kernels in :data:`SOURCE`."""

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
extern "C" __global__ void fold(const float* __restrict__ colors, int color_stride, const float* __restrict__ alpha,
                                int alpha_stride, const float* __restrict__ features, int feature_stride,
                                int num_colors, int num_features, int padded, int height, int width, int rows,
                                int columns, T* __restrict__ out) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)rows * columns * padded) return;
    const int c = (int)(i % padded);
    const long long block = i / padded;
    const int x = (int)(block % columns), y = (int)(block / columns);
    const float* from = features + (c - num_colors);
    int stride = feature_stride;
    if (c < num_colors) {
        from = c < 3 ? colors + c : alpha;
        stride = c < 3 ? color_stride : alpha_stride;
    }
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
"""

Launch = Callable[[int, list["Tensor | int | float"]], None]
"""Runs one kernel for so many threads, at least, with these arguments."""

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


@dataclass
class Weights:
    """What the convolutions read: the network's weights in the dtype of the arithmetic, channels last."""

    source: list[Tensor]
    cast: list[Tensor]
    padded: Tensor
    """The first convolution's, with as many channels as a folded picture has."""

    @classmethod
    def of(cls, net: UNet, dtype: torch.dtype) -> Weights:
        """Room for the weights of a network; :meth:`refresh` fills it."""
        first, *others = (conv.weight.detach() for conv in _convolutions(net))
        channels = padded_channels(first.shape[1] // net.pixel_unshuffle**2, net.pixel_unshuffle)
        shape = (len(first), channels * net.pixel_unshuffle**2, *first.shape[2:])
        padded = first.new_zeros(shape, dtype=dtype).contiguous(memory_format=torch.channels_last)
        cast = [torch.empty_like(w, dtype=dtype, memory_format=torch.channels_last) for w in others]
        return cls([first, *others], cast, padded)

    def refresh(self) -> None:
        """Take over what the network has learnt since."""
        first, *others = self.source
        self.padded[:, : first.shape[1]].copy_(first)
        torch._foreach_copy_(self.cast, others)


def padded_channels(channels: int, fold: int) -> int:
    """Channels of an unfolded pixel, the empty ones included, such that the folded picture has whole packs."""
    per_pack = PACK // math.gcd(PACK, fold**2)
    return -(-channels // per_pack) * per_pack


def correction(net: UNet, weights: Weights, folded: Tensor, launches: Launches) -> Tensor:
    """The network from its folded input to what the last kernel makes the picture from.

    Args:
        net: gives the biases.
        weights: of the network.
        folded: ``[1, C, h, w]`` channels last.
        launches: the kernels.

    Returns:
        Result of the last 3 x 3 convolution, without bias and activation, ``[1, width, h, w]`` channels last.
    """
    levels = len(net.encoder)
    convs = iter(zip([weights.padded, *weights.cast], _convolutions(net), strict=True))

    def convolved(x: Tensor) -> tuple[Tensor, Tensor]:
        weight, conv = next(convs)
        raw = F.conv2d(x, weight, padding=1).contiguous(memory_format=torch.channels_last)
        return raw, _bias(conv)

    def double(x: Tensor) -> tuple[Tensor, Tensor]:
        raw, bias = convolved(x)
        count, channels, rows, columns = raw.shape
        launches["activate"](raw.numel() // PACK, [raw, bias, channels, count * rows * columns])
        return convolved(raw)

    x, wide = folded, []
    for level in range(levels):
        raw, bias = double(x)
        if level == levels - 1:
            break
        _, channels, rows, columns = raw.shape
        # The skip connection needs no copy: it is written where the decoder finds it.
        room = _channels_last(raw, channels + _width(net, level + 1), rows, columns)
        x = _channels_last(raw, channels, rows // 2, columns // 2)
        launches["pool"](x.numel() // PACK, [raw, bias, channels, rows, columns, room, room.shape[1], x])
        wide.append(room)
    for room in reversed(wide):
        _, channels, rows, columns = raw.shape
        threads = 4 * raw.numel() // PACK
        launches["upsample"](threads, [raw, bias, channels, rows, columns, room, room.shape[1]])
        raw, bias = double(room)
    return raw


class _Recording(NamedTuple):
    graph: torch.cuda.CUDAGraph
    folded: Tensor
    """Where the graph reads."""
    raw: Tensor
    """Where it writes."""


class FusedInference:
    """Compensated pictures of a network without gradients, with its newest weights.

    A plain object that refers to the network, so that recordings and weights stay out of checkpoints.

    Args:
        net: the network; its parameters must stay the same tensors while they stay on their device.
        residual: whether its output corrects a picture, or is one.
    """

    def __init__(self, net: UNet, residual: bool) -> None:
        self.net = net
        self.residual = residual
        self._recorded: OrderedDict[tuple[object, ...], _Recording] = OrderedDict()
        self._last: tuple[object, ...] | None = None
        self._in_a_row = 0

    def __call__(
        self, base: Tensor, colors: Tensor, features: Tensor, alpha: Tensor, dtype: torch.dtype, *, record: bool = True
    ) -> Tensor:
        """One picture.

        Args:
            base: float32, on CUDA ``[H, W, 3]``.
            colors: likewise ``[H, W, 3]``; rows of pixels without gaps, but pixels may be apart, as in all others.
            features: likewise ``[H, W, F]``.
            alpha: likewise ``[H, W, 1]``.
            dtype: arithmetic, float16 or bfloat16.
            record: whether a size that stays becomes a CUDA graph.

        Returns:
            ``[H, W, 3]`` float32, see :meth:`sundae_ns.compensation.CompensationHead.forward`.

        Raises:
            BackendError: the kernels cannot be compiled or loaded here.
        """
        net = self.net
        launches = _launches(base.device, dtype, definitions(net, self.residual))
        height, width = base.shape[:2]
        key = (height, width, dtype, net.out.weight.data_ptr())
        self._in_a_row = self._in_a_row + 1 if key == self._last else 1
        self._last = key
        if record and key not in self._recorded and self._in_a_row >= RECORD_AT:
            if len(self._recorded) >= MAX_SIZES:
                self._recorded.popitem(last=False)
            self._recorded[key] = self._record(base, dtype, launches)
        recording = self._recorded.get(key)
        folded = _folded_room(net, base, dtype) if recording is None else recording.folded
        fold(colors, alpha, features, net.pixel_unshuffle, self.residual, folded, launches)
        if recording is None:
            raw = self._run(folded, dtype, launches)
        else:
            self._recorded.move_to_end(key)
            recording.graph.replay()
            raw = recording.raw
        return unfold(net, raw, base, alpha, launches)

    def _run(self, folded: Tensor, dtype: torch.dtype, launches: Launches) -> Tensor:
        weights = Weights.of(self.net, dtype)
        weights.refresh()
        return correction(self.net, weights, folded, launches)

    def _record(self, base: Tensor, dtype: torch.dtype, launches: Launches) -> _Recording:
        folded = _folded_room(self.net, base, dtype).zero_()
        # What runs first on a stream of its own allocates and chooses kernels, neither of which can be recorded.
        side = torch.cuda.Stream(base.device)
        side.wait_stream(torch.cuda.current_stream(base.device))
        with torch.cuda.stream(side):
            self._run(folded, dtype, launches)
        torch.cuda.current_stream(base.device).wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        # A training loop beside a viewer may allocate meanwhile; only this thread's work belongs to the recording.
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            # Casting half a million weights takes no time, and shows what was learnt since the last picture.
            raw = self._run(folded, dtype, launches)
        return _Recording(graph, folded, raw)


def fold(
    colors: Tensor, alpha: Tensor, features: Tensor, size: int, residual: bool, folded: Tensor, launches: Launches
) -> None:
    """Put what was splatted into the network's input, blocks of ``size`` pixels a side folded into channels."""
    height, width = features.shape[:2]
    rows, columns = folded.shape[-2:]
    padded = folded.shape[1] // size**2
    threads = rows * columns * padded
    launches["fold"](
        threads,
        [
            *(colors, _pixel_stride(colors), alpha, _pixel_stride(alpha), features, _pixel_stride(features)),
            *(4 if residual else 0, features.shape[2], padded),
            *(height, width, rows, columns, folded),
        ],
    )


def unfold(net: UNet, raw: Tensor, base: Tensor, alpha: Tensor, launches: Launches) -> Tensor:
    """The picture from the result of the last 3 x 3 convolution ``[H, W, 3]``."""
    height, width = base.shape[:2]
    rows, columns = raw.shape[-2:]
    base = base.contiguous()
    out = torch.empty_like(base)
    last = cast("nn.Conv2d", cast("nn.Sequential", net.decoder[-1])[2])
    weight = net.out.weight.detach().reshape(len(net.out.weight), -1).contiguous()
    launches["unfold"](
        rows * columns,
        [
            *(raw, _bias(last), weight, _bias(net.out)),
            *(rows, columns),
            *(base, alpha, _pixel_stride(alpha)),
            *(height, width, out),
        ],
    )
    return out


def _folded_room(net: UNet, base: Tensor, dtype: torch.dtype) -> Tensor:
    size = net.pixel_unshuffle
    stride = 2 ** (len(net.encoder) - 1)
    rows, columns = (-(-side // (size * stride)) * stride for side in base.shape[:2])
    channels = padded_channels(_convolutions(net)[0].in_channels // size**2, size) * size**2
    shape = (1, channels, rows, columns)
    return torch.empty(shape, dtype=dtype, device=base.device, memory_format=torch.channels_last)


def _convolutions(net: UNet) -> list[nn.Conv2d]:
    """The 3 x 3 convolutions, in the order in which they run."""
    blocks = [cast("nn.Sequential", block) for block in (*net.encoder, *net.decoder)]
    return [cast("nn.Conv2d", layer) for block in blocks for layer in block if isinstance(layer, nn.Conv2d)]


def _width(net: UNet, level: int) -> int:
    return cast("nn.Conv2d", cast("nn.Sequential", net.encoder[level])[0]).out_channels


def _bias(conv: nn.Conv2d) -> Tensor:
    assert conv.bias is not None
    return conv.bias.detach()


def _channels_last(like: Tensor, channels: int, rows: int, columns: int) -> Tensor:
    shape = (1, channels, rows, columns)
    return torch.empty(shape, dtype=like.dtype, device=like.device, memory_format=torch.channels_last)


def _pixel_stride(picture: Tensor) -> int:
    """Values from one pixel to the next; the rows of a slice of channels follow each other without gaps."""
    row, pixel, channel = picture.stride()
    assert row == pixel * picture.shape[1]
    assert channel == 1 or picture.shape[2] == 1
    return pixel


@functools.cache
def _launches(device: torch.device, dtype: torch.dtype, options: tuple[str, ...]) -> Launches:
    """The kernels for a device, compiled once."""
    return {name: Kernel(program(dtype), name, device, options) for name in KERNELS}
