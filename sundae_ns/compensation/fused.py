"""The head without gradients, in a few kernels: for inference.

cuDNN convolves. Layer by layer, most of the head's time goes to reading and writing images: bias, activation, pooling,
upsampling and concatenation are a pass each. A kernel of ``csrc/head.cu`` does everything between two convolutions in
one pass, and writes its result where the next convolution reads it. The network is recorded as one CUDA graph per image
size that repeats. :mod:`sundae_ns.compensation.fused_training` computes gradients.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sundae_ns.compensation.unet import SLOPE, UNet
from sundae_ns.errors import BackendError
from sundae_ns.gpu.cuda_graphs import GraphCache, is_recording, record, warm_up
from sundae_ns.gpu.kernels import Argument, Launch, load_kernels

_log = logging.getLogger(__name__)

PACK = 8
"""Channels that a thread moves at once, 16 bytes; images are padded to a multiple, which tensor cores need too."""

_FORWARD = ("fold", "activate", "pool", "upsample", "unfold")

KERNELS = (*_FORWARD, *(f"{name}_backward" for name in _FORWARD), "sum_pixels")
"""Names of the kernels of ``head.cu``."""

_TYPES = {torch.bfloat16: "-DBF16"}
"""Compiler option for the dtype of images between the convolutions; tests add float32, on a CPU."""

Launches = Mapping[str, Launch]
"""Launch functions by kernel name."""


def head_options(net: UNet, residual: bool) -> tuple[str, ...]:
    """Compiler options for a network: its fold, its widths, and whether it corrects an image."""
    widths = [layer.out_channels for layer in net.modules() if isinstance(layer, nn.Conv2d)]
    return (
        f"-DMOST_CHANNELS={max(widths)}",
        f"-DR={net.pixel_unshuffle}",
        f"-DWIDTH={net.out.in_channels}",
        f"-DPACK={PACK}",
        f"-DSLOPE={SLOPE}f",
        f"-DRESIDUAL={int(residual)}",
    )


def head_kernels(device: torch.device, dtype: torch.dtype, options: tuple[str, ...]) -> Launches:
    """The kernels for a device, compiled on the first call.

    Raises:
        BackendError: the kernels cannot be compiled or loaded.
    """
    return load_kernels("head.cu", KERNELS, (_TYPES[dtype], *options), device)


class Weights:
    """A network's convolution weights in the dtype of the arithmetic, channels last."""

    def __init__(self, net: UNet, dtype: torch.dtype) -> None:
        first, *others = (conv.weight.detach() for conv in convolutions(net))
        channels = padded_channels(first.shape[1] // net.pixel_unshuffle**2, net.pixel_unshuffle)
        shape = (len(first), channels * net.pixel_unshuffle**2, *first.shape[2:])
        self._source = [first, *others]
        # The number of channels of a folded image.
        padded = first.new_zeros(shape, dtype=dtype).contiguous(memory_format=torch.channels_last)
        self.cast = [padded, *(torch.empty_like(w, dtype=dtype, memory_format=torch.channels_last) for w in others)]
        self.refresh()

    def refresh(self) -> None:
        """Copy the network's current weights."""
        first, *others = self._source
        self.cast[0][:, : first.shape[1]].copy_(first)
        torch._foreach_copy_(self.cast[1:], others)


class Tape(NamedTuple):
    """Values that the backward pass needs: inputs of the convolutions, and results before their bias and activation."""

    inputs: list[Tensor]
    """Inputs of all 3 x 3 convolutions, in order; every second one holds the activations of the convolution before."""
    coarse: list[Tensor]
    """Inputs of the upsamplings, from the coarsest level on."""
    last: Tensor
    """Input of the last kernel: the result of the last 3 x 3 convolution, without bias and activation.

    ``[1, width, h, w]`` channels last."""


def padded_channels(channels: int, fold: int) -> int:
    """Channels of an unfolded pixel, including padding, such that the folded image has whole packs."""
    per_pack = PACK // math.gcd(PACK, fold**2)
    return -(-channels // per_pack) * per_pack


def fold_pixels(splatted: Tensor, alpha: Tensor, size: int, residual: bool, folded: Tensor, launches: Launches) -> None:
    """Write splatted values to the network's input ``folded``, ``size`` x ``size`` pixels in the channels of one.

    Splatted values ``[H, W, 3 + F]`` and accumulation ``[H, W, 1]`` are float32; their pixels may have a stride, their
    rows must be adjacent. Only a residual network sees colours and accumulation.
    """
    height, width = splatted.shape[:2]
    rows, columns = folded.shape[-2:]
    padded = folded.shape[1] // size**2
    images: list[Argument] = [splatted, pixel_stride(splatted), alpha, pixel_stride(alpha)]
    sizes = [4 if residual else 0, splatted.shape[2] - 3, padded, height, width, rows, columns]
    launches["fold"](rows * columns * padded, [*images, *sizes, folded])


def network(net: UNet, weights: Weights, folded: Tensor, launches: Launches) -> Tape:
    """Run the network from its folded input ``[1, C, h, w]``, channels last, to the input of the last kernel."""
    levels = len(net.encoder)
    inputs, coarse = [], []
    convs = iter(zip(weights.cast, convolutions(net), strict=True))

    def convolved(x: Tensor) -> tuple[Tensor, Tensor]:
        weight, conv = next(convs)
        inputs.append(x)
        return F.conv2d(x, weight, padding=1).contiguous(memory_format=torch.channels_last), bias_of(conv)

    def double(x: Tensor) -> tuple[Tensor, Tensor]:
        raw, bias = convolved(x)
        _, channels, rows, columns = raw.shape
        launches["activate"](raw.numel() // PACK, [raw, bias, channels, rows * columns])
        return convolved(raw)

    x, skips = folded, []
    raw, bias = double(x)
    for level in range(1, levels):
        _, channels, rows, columns = raw.shape
        # The skip connection needs no copy: it is written where the decoder reads it.
        coarser = cast("nn.Conv2d", cast("nn.Sequential", net.encoder[level])[0]).out_channels
        skip = image_like(raw, channels + coarser, rows, columns)
        x = image_like(raw, channels, rows // 2, columns // 2)
        launches["pool"](x.numel() // PACK, [raw, bias, channels, rows, columns, skip, skip.shape[1], x])
        skips.append(skip)
        raw, bias = double(x)
    for skip in reversed(skips):
        _, channels, rows, columns = raw.shape
        coarse.append(raw)
        threads = 4 * raw.numel() // PACK
        launches["upsample"](threads, [raw, bias, channels, rows, columns, skip, skip.shape[1]])
        raw, bias = double(skip)
    return Tape(inputs, coarse, raw)


def unfold_pixels(net: UNet, raw: Tensor, base: Tensor, alpha: Tensor, launches: Launches) -> Tensor:
    """The image ``[H, W, 3]`` from the last 3 x 3 convolution's result ``[1, width, h, w]``.

    A residual network corrects ``base`` ``[H, W, 3]`` in proportion to accumulation ``[H, W, 1]``; of another network
    only the size of ``base`` matters. All but ``raw`` are float32.
    """
    height, width = base.shape[:2]
    rows, columns = raw.shape[-2:]
    base = base.contiguous()
    out = torch.empty_like(base)
    layers: list[Argument] = [raw, *last_layers(net), rows, columns]
    images: list[Argument] = [base, alpha, pixel_stride(alpha), height, width, out]
    launches["unfold"](rows * columns, [*layers, *images])
    return out


def folded_input(net: UNet, height: int, width: int, like: Tensor, dtype: torch.dtype) -> Tensor:
    """An uninitialised input of the network for an image size, ``[1, C, h, w]`` channels last."""
    size = net.pixel_unshuffle
    stride = 2 ** (len(net.encoder) - 1)
    rows, columns = (-(-side // (size * stride)) * stride for side in (height, width))
    channels = padded_channels(convolutions(net)[0].in_channels // size**2, size) * size**2
    return image_like(like, channels, rows, columns, dtype)


def convolutions(net: UNet) -> list[nn.Conv2d]:
    """The 3 x 3 convolutions, in the order of execution."""
    blocks = [cast("nn.Sequential", block) for block in (*net.encoder, *net.decoder)]
    return [layer for block in blocks for layer in block if isinstance(layer, nn.Conv2d)]


def last_layers(net: UNet) -> tuple[Tensor, Tensor, Tensor]:
    """Bias of the last 3 x 3 convolution, then weights ``[C, width]`` and bias of the 1 x 1 convolution."""
    weight = net.out.weight.detach().reshape(len(net.out.weight), -1).contiguous()
    return bias_of(convolutions(net)[-1]), weight, bias_of(net.out)


def bias_of(conv: nn.Conv2d) -> Tensor:
    """The bias of a convolution; all of the network's have one."""
    assert conv.bias is not None
    return conv.bias.detach()


def image_like(like: Tensor, channels: int, rows: int, columns: int, dtype: torch.dtype | None = None) -> Tensor:
    """An uninitialised image ``[1, channels, rows, columns]``, channels last."""
    shape = (1, channels, rows, columns)
    dtype = like.dtype if dtype is None else dtype
    return torch.empty(shape, dtype=dtype, device=like.device, memory_format=torch.channels_last)


def pixel_stride(image: Tensor) -> int:
    """Stride, in values, between pixels of ``[H, W, C]``; rows must be adjacent, as in a slice of channels."""
    row, pixel, channel = image.stride()
    assert row == pixel * image.shape[1] or image.shape[0] == 1
    assert channel == 1 or image.shape[2] == 1
    return pixel


class _Recording(NamedTuple):
    graph: torch.cuda.CUDAGraph
    folded: Tensor
    """Input of the graph."""
    raw: Tensor
    """Output of the graph."""


class FusedInference:
    """Compensated images of a network without gradients, with its current weights.

    A plain object that refers to the network, so that graphs and weights stay out of checkpoints. The network's
    parameters must stay the same tensors while on one device. A residual network corrects an image.
    """

    def __init__(self, net: UNet, residual: bool) -> None:
        self.net = net
        self.residual = residual
        self._recorded: GraphCache[_Recording] = GraphCache()
        self._can_record = True

    def __call__(self, base: Tensor, splatted: Tensor, alpha: Tensor, dtype: torch.dtype) -> Tensor:
        """Compensate one image; see :meth:`sundae_ns.compensation.CompensationHead.forward`.

        All images are float32 on CUDA. Pixels of ``splatted`` and ``alpha`` may have a stride, rows must be adjacent.
        ``dtype`` is that of the arithmetic, bfloat16.

        Raises:
            BackendError: the kernels cannot be compiled or loaded.
        """
        net = self.net
        launches = head_kernels(base.device, dtype, head_options(net, self.residual))
        height, width = base.shape[:2]
        key = (height, width, dtype, net.out.weight.data_ptr())
        new_input = partial(folded_input, net, height, width, base, dtype)
        recorded = None
        if self._can_record and not is_recording():
            try:
                recorded = self._recorded.get(key, lambda: self._record(new_input().zero_(), launches))
            except BackendError as error:
                _log.warning("the head is not recorded and runs kernel by kernel: %s", error)
                self._can_record = False
        folded = new_input() if recorded is None else recorded.folded
        fold_pixels(splatted, alpha, net.pixel_unshuffle, self.residual, folded, launches)
        if recorded is None:
            raw = self._run(folded, launches)
        else:
            recorded.graph.replay()
            raw = recorded.raw
        return unfold_pixels(net, raw, base, alpha, launches)

    def _run(self, folded: Tensor, launches: Launches) -> Tensor:
        # Casting half a million weights costs nothing, and follows the network's training.
        return network(self.net, Weights(self.net, folded.dtype), folded, launches).last

    def _record(self, folded: Tensor, launches: Launches) -> _Recording:
        with warm_up(folded.device):
            self._run(folded, launches)
        graph, raw = record(lambda: self._run(folded, launches), folded.device)
        return _Recording(graph, folded, raw)
