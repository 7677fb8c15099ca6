"""The head in a few CUDA kernels, forward and backward.

cuDNN convolves. Layer by layer, most of the head's time goes to reading and writing images: bias, activation, pooling,
upsampling and concatenation are a pass each. A kernel of ``csrc/head.cu`` does everything between two convolutions in
one pass, and writes its result where the next convolution reads it. Frames and training steps are recorded as a whole,
with the head in them, because launching a hundred small kernels from Python takes longer than running them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from sundae_ns.core.values import usual_defaults
from sundae_ns.cuda.kernels import Argument, Launch, load_kernels
from sundae_ns.head.unet import SLOPE, UNet

PACK = 8  # channels that a thread moves at once, 16 bytes; images are padded to a multiple, which tensor cores need too
_FORWARD = ("fold", "activate", "pool", "upsample", "unfold")

KERNELS = (*_FORWARD, *(f"{name}_backward" for name in _FORWARD), "sum_pixels")  # names of the kernels of head.cu
_TYPES = {torch.bfloat16: "-DBF16"}  # Compiler option for the dtype of images between convolutions; tests add float32
Launches = Mapping[str, Launch]  # Launch functions by kernel name

MOST_WORKERS = 2**17  # Threads that sum a gradient over the pixels; fewer leave the GPU idle, more wait for each other


def compensated(net: UNet, residual: bool, base: Tensor, splatted: Tensor, alpha: Tensor, dtype: torch.dtype) -> Tensor:
    """The compensated image of a network without gradients; see :meth:`CompensationHead.forward`.

    All images are float32 on CUDA, the arithmetic has ``dtype``, bfloat16. Pixels of ``splatted`` and ``alpha`` may
    have a stride, rows must be adjacent. ``BackendError`` if the kernels cannot be compiled or loaded.
    """
    launches = head_kernels(base.device, dtype, head_options(net, residual))
    folded = fold_pixels(net, residual, splatted, alpha, dtype, launches)
    last = network(net, cast_weights(net, dtype), folded, launches).last
    return unfold_pixels(net, last, base, alpha, launches)


def correction(net: UNet, residual: bool, splatted: Tensor, alpha: Tensor, dtype: torch.dtype) -> Tensor:
    """One correction times accumulation, or one image if the network makes it by itself: ``[H, W, 3]`` float32.

    Once differentiable, by splatted values, accumulation and the network's parameters. Arguments and errors are those
    of :func:`compensated`.
    """
    parameters = [value for layer in (*convolutions(net), net.out) for value in (layer.weight, layer.bias)]
    return cast("Tensor", _Correction.apply(splatted, alpha, net, residual, dtype, *parameters))


class _Correction(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, splatted: Tensor, alpha: Tensor, net: UNet, residual: bool, dtype: torch.dtype, *_: Tensor
    ) -> Tensor:
        height, width, ctx.channels = splatted.shape
        ctx.net, ctx.residual, ctx.weights = net, residual, cast_weights(net, dtype)
        ctx.launches = head_kernels(splatted.device, dtype, head_options(net, residual))
        folded = fold_pixels(net, residual, splatted, alpha, dtype, ctx.launches)
        ctx.tape = network(net, ctx.weights, folded, ctx.launches)
        ctx.save_for_backward(alpha)
        return unfold_pixels(net, ctx.tape.last, splatted.new_zeros(height, width, 3), alpha, ctx.launches)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (alpha,) = ctx.saved_tensors
        net, launches, tape = ctx.net, ctx.launches, ctx.tape
        grad_raw, grad_alpha, *grad_last = unfold_backward(net, tape.last, gradient, alpha, launches)
        grad_folded, grad_parameters = network_backward(net, ctx.weights, tape, grad_raw, launches)
        # Channels that the network does not see have no gradient.
        new = torch.empty if ctx.residual else torch.zeros
        height, width = gradient.shape[:2]
        grad_splatted = new(height, width, ctx.channels, dtype=torch.float32, device=gradient.device)
        rows, columns = grad_folded.shape[-2:]
        padded = grad_folded.shape[1] // net.pixel_unshuffle**2
        sizes = [4 if ctx.residual else 0, ctx.channels - 3, padded, height, width, rows, columns]
        launches["fold_backward"](rows * columns * padded, [grad_folded, *sizes, grad_splatted, grad_alpha])
        return grad_splatted, grad_alpha, None, None, None, *grad_parameters, *grad_last


def head_options(net: UNet, residual: bool) -> tuple[str, ...]:
    """Compiler options for a network: its fold, its widths, and whether it corrects an image."""
    widths = [layer.out_channels for layer in net.modules() if isinstance(layer, nn.Conv2d)]
    sizes = (f"-DMOST_CHANNELS={max(widths)}", f"-DR={net.pixel_unshuffle}", f"-DWIDTH={net.out.in_channels}")
    return *sizes, f"-DPACK={PACK}", f"-DSLOPE={SLOPE}f", f"-DRESIDUAL={int(residual)}"


def head_kernels(device: torch.device, dtype: torch.dtype, options: tuple[str, ...]) -> Launches:
    """The kernels for a device, compiled on the first call; ``BackendError`` if they cannot be compiled or loaded."""
    return load_kernels("head.cu", KERNELS, (_TYPES[dtype], *options), device)


class Tape(NamedTuple):
    """Values that the backward pass needs: inputs of the convolutions, and results before their bias and activation."""

    inputs: list[Tensor]  # Of all 3 x 3 convolutions; every second one holds the activations of the convolution before
    coarse: list[Tensor]  # Inputs of the upsamplings, from the coarsest level on
    last: Tensor  # Input of the last kernel: the last 3 x 3 convolution before bias and activation ``[1, width, h, w]``


def cast_weights(net: UNet, dtype: torch.dtype) -> list[Tensor]:
    """The weights of the 3 x 3 convolutions in the dtype of the arithmetic, channels last; half a million values."""
    first, *others = (conv.weight.detach() for conv in convolutions(net))
    channels = padded_channels(first.shape[1] // net.pixel_unshuffle**2, net.pixel_unshuffle) * net.pixel_unshuffle**2
    shape = (len(first), channels, *first.shape[2:])  # as many as a folded image has
    padded = first.new_zeros(shape, dtype=dtype).contiguous(memory_format=torch.channels_last)
    padded[:, : first.shape[1]].copy_(first)
    rest = [torch.empty_like(w, dtype=dtype, memory_format=torch.channels_last) for w in others]
    torch._foreach_copy_(rest, others)
    return [padded, *rest]


def padded_channels(channels: int, fold: int) -> int:
    """Channels of an unfolded pixel, including padding, such that the folded image has whole packs."""
    per_pack = PACK // math.gcd(PACK, fold**2)
    return -(-channels // per_pack) * per_pack


def fold_pixels(
    net: UNet, residual: bool, splatted: Tensor, alpha: Tensor, dtype: torch.dtype, launches: Launches
) -> Tensor:
    """Splatted values as the network's input ``[1, C, h, w]``, a square of pixels in the channels of one.

    Splatted values ``[H, W, 3 + F]`` and accumulation ``[H, W, 1]`` are float32; their pixels may have a stride, their
    rows must be adjacent. Only a residual network sees colours and accumulation.
    """
    height, width, channels = splatted.shape
    size, stride = net.pixel_unshuffle, 2 ** (len(net.encoder) - 1)
    rows, columns = (-(-side // (size * stride)) * stride for side in (height, width))
    padded = padded_channels(convolutions(net)[0].in_channels // size**2, size)
    folded = image_like(splatted, padded * size**2, rows, columns, dtype)
    images: list[Argument] = [splatted, pixel_stride(splatted), alpha, pixel_stride(alpha)]
    sizes = [4 if residual else 0, channels - 3, padded, height, width, rows, columns]
    launches["fold"](rows * columns * padded, [*images, *sizes, folded])
    return folded


@usual_defaults()  # autocast would convolve in a dtype that the kernels do not read
def network(net: UNet, weights: list[Tensor], folded: Tensor, launches: Launches) -> Tape:
    """Run the network from its folded input ``[1, C, h, w]``, channels last, to the input of the last kernel."""
    levels = len(net.encoder)
    inputs: list[Tensor] = []
    coarse: list[Tensor] = []
    convs = iter(zip(weights, convolutions(net), strict=True))

    def convolved(x: Tensor) -> tuple[Tensor, Tensor]:
        weight, conv = next(convs)
        inputs.append(x)
        return F.conv2d(x, weight, padding=1).contiguous(memory_format=torch.channels_last), bias_of(conv)

    def double(x: Tensor) -> tuple[Tensor, Tensor]:
        raw, bias = convolved(x)
        _, channels, rows, columns = raw.shape
        launches["activate"](raw.numel() // PACK, [raw, bias, channels, rows * columns])
        return convolved(raw)

    skips = []
    raw, bias = double(folded)
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
        launches["upsample"](4 * raw.numel() // PACK, [raw, bias, channels, rows, columns, skip, skip.shape[1]])
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
    return cast("Tensor", conv.bias).detach()


def image_like(like: Tensor, channels: int, rows: int, columns: int, dtype: torch.dtype | None = None) -> Tensor:
    """An uninitialised image ``[1, channels, rows, columns]``, channels last."""
    return like.new_empty(1, rows, columns, channels, dtype=dtype).permute(0, 3, 1, 2)


def pixel_stride(image: Tensor) -> int:
    """Stride, in values, between pixels of ``[H, W, C]``; rows must be adjacent, as in a slice of channels."""
    row, pixel, channel = image.stride()
    assert row == pixel * image.shape[1] or image.shape[0] == 1
    assert channel == 1 or image.shape[2] == 1
    return pixel


def network_backward(
    net: UNet, weights: list[Tensor], tape: Tape, gradient: Tensor, launches: Launches
) -> tuple[Tensor, list[Tensor]]:
    """Gradients of :func:`network`, with the weights and the tape of the forward pass.

    ``gradient`` is that of the last 3 x 3 convolution's result with its bias ``[1, width, h, w]``. Returns those of the
    folded input ``[1, C, h, w]``, both channels last, and of weight and bias of each convolution in turn, float32.
    """
    levels = len(net.encoder)
    widths = [conv.out_channels for conv in convolutions(net)]
    grad_biases = torch.zeros(sum(widths), dtype=torch.float32, device=gradient.device).split(widths)
    gradients: dict[int, tuple[Tensor, Tensor]] = {}

    def convolved(number: int, grad_raw: Tensor) -> Tensor:
        x, weight = tape.inputs[number], weights[number]
        pixels = grad_raw.shape[2] * grad_raw.shape[3]
        workers = min(pixels * widths[number] // PACK, MOST_WORKERS)
        launches["sum_pixels"](workers, [grad_raw, widths[number], pixels, workers, grad_biases[number]])
        grad_x, grad_weight, _ = torch.ops.aten.convolution_backward(
            grad_raw, x, weight, None, [1, 1], [1, 1], [1, 1], False, [0, 0], 1, [True, True, False]
        )
        channels = convolutions(net)[number].in_channels
        # The memory format of the weights, so that autograd need not copy the gradient.
        grad_weight = grad_weight[:, :channels].float().contiguous(memory_format=torch.channels_last)
        gradients[number] = grad_weight, grad_biases[number]
        return cast("Tensor", grad_x).contiguous(memory_format=torch.channels_last)

    def double(block: int, grad_raw: Tensor) -> Tensor:
        grad_middle = convolved(2 * block + 1, grad_raw)
        _, channels, rows, columns = grad_middle.shape
        middle = tape.inputs[2 * block + 1]
        launches["activate_backward"](grad_middle.numel() // PACK, [grad_middle, middle, channels, rows * columns])
        return convolved(2 * block, grad_middle)

    grad_skips = []
    for step in reversed(range(levels - 1)):
        grad_skip = double(levels + step, gradient)
        grad_skips.append(grad_skip)
        coarse = tape.coarse[step]
        _, channels, rows, columns = coarse.shape
        # The second convolution of the coarser block precedes those of this block.
        bias = bias_of(convolutions(net)[2 * (levels + step) - 1])
        gradient = torch.empty_like(coarse)
        arguments: list[Argument] = [grad_skip, grad_skip.shape[1], coarse, bias, channels, rows, columns, gradient]
        launches["upsample_backward"](coarse.numel() // PACK, arguments)
    gradient = double(levels - 1, gradient)
    for level in reversed(range(levels - 1)):
        grad_skip, skip = grad_skips[level], tape.inputs[2 * (2 * levels - 2 - level)]
        rows, columns = skip.shape[-2:]
        channels = gradient.shape[1]
        grad_raw = image_like(gradient, channels, rows, columns)
        arguments = [grad_skip, skip, skip.shape[1], gradient, channels, rows, columns, grad_raw]
        launches["pool_backward"](grad_raw.numel() // PACK, arguments)
        gradient = double(level, grad_raw)
    return gradient, [tensor for number in range(len(gradients)) for tensor in gradients[number]]


@usual_defaults()
def unfold_backward(
    net: UNet, raw: Tensor, gradient: Tensor, alpha: Tensor, launches: Launches
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of :func:`unfold_pixels`, from that of the image ``[H, W, 3]``.

    They are those of ``raw``, of accumulation ``[H, W, 1]``, and of weight and bias of the 1 x 1 convolution; the last
    three are float32.
    """
    height, width = gradient.shape[:2]
    rows, columns = raw.shape[-2:]
    outputs = len(net.out.weight)
    gradient = gradient.contiguous()
    grad_raw = torch.empty_like(raw)
    values, grad_values = raw.new_empty(rows, columns, raw.shape[1]), raw.new_empty(rows, columns, outputs)
    grad_alpha = torch.zeros_like(alpha, memory_format=torch.contiguous_format)
    layers: list[Argument] = [raw, *last_layers(net), rows, columns]
    images: list[Argument] = [gradient, alpha, pixel_stride(alpha), height, width]
    launches["unfold_backward"](rows * columns, [*layers, *images, grad_raw, values, grad_values, grad_alpha])
    # Sum row by row: as one product it would be a single sum over all pixels, which a GPU cannot parallelise.
    grad_weight = torch.bmm(grad_values.transpose(1, 2), values).sum(dim=0, dtype=torch.float32)
    grad_bias = grad_values.sum(dim=(0, 1), dtype=torch.float32)
    return grad_raw, grad_alpha, grad_weight.reshape(net.out.weight.shape), grad_bias
