"""The head with gradients, through the same kernels: for training.

Both directions are recorded as CUDA graphs per image size: on a pruned field, launching a hundred small kernels from
Python would take longer than running them.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from sundae_ns.compensation.fused import (
    PACK,
    Launches,
    Tape,
    Weights,
    bias_of,
    convolutions,
    fold_pixels,
    folded_input,
    head_kernels,
    head_options,
    image_like,
    last_layers,
    network,
    pixel_stride,
    unfold_pixels,
)
from sundae_ns.compensation.unet import UNet
from sundae_ns.errors import BackendError, SundaeError
from sundae_ns.gpu.cuda_graphs import MAX_GRAPHS, is_recording, record, warm_up
from sundae_ns.gpu.kernels import Argument

MOST_WORKERS = 2**17
"""Threads that sum a gradient over the pixels; fewer leave the GPU idle, and more wait for each other to add."""

_log = logging.getLogger(__name__)


def network_backward(
    net: UNet, weights: Weights, tape: Tape, gradient: Tensor, launches: Launches
) -> tuple[Tensor, list[Tensor]]:
    """Gradients of :func:`sundae_ns.compensation.fused.network`, with the weights and the tape of the forward pass.

    Args:
        gradient: gradient of the last 3 x 3 convolution's result with its bias ``[1, width, h, w]``, channels last.

    Returns:
        The gradients of the folded input ``[1, C, h, w]``, channels last, and of weight and bias of each 3 x 3
        convolution in turn, float32.
    """
    levels = len(net.encoder)
    widths = [conv.out_channels for conv in convolutions(net)]
    grad_biases = torch.zeros(sum(widths), device=gradient.device).split(widths)
    gradients: dict[int, tuple[Tensor, Tensor]] = {}

    def convolved(number: int, grad_raw: Tensor) -> Tensor:
        x, weight = tape.inputs[number], weights.cast[number]
        pixels = grad_raw.shape[2] * grad_raw.shape[3]
        workers = min(pixels * widths[number] // PACK, MOST_WORKERS)
        launches["sum_pixels"](workers, [grad_raw, widths[number], pixels, workers, grad_biases[number]])
        grad_x, grad_weight, _ = torch.ops.aten.convolution_backward(
            grad_raw, x, weight, None, [1, 1], [1, 1], [1, 1], False, [0, 0], 1, [True, True, False]
        )
        channels = convolutions(net)[number].in_channels
        # The memory format of the weights, so that autograd need not copy the gradient.
        gradients[number] = (
            grad_weight[:, :channels].float().contiguous(memory_format=torch.channels_last),
            grad_biases[number],
        )
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
        launches["upsample_backward"](
            coarse.numel() // PACK,
            [grad_skip, grad_skip.shape[1], coarse, bias, channels, rows, columns, gradient],
        )
    gradient = double(levels - 1, gradient)
    for level in reversed(range(levels - 1)):
        grad_skip, skip = grad_skips[level], tape.inputs[2 * (2 * levels - 2 - level)]
        rows, columns = skip.shape[-2:]
        channels = gradient.shape[1]
        grad_raw = image_like(gradient, channels, rows, columns)
        launches["pool_backward"](
            grad_raw.numel() // PACK, [grad_skip, skip, skip.shape[1], gradient, channels, rows, columns, grad_raw]
        )
        gradient = double(level, grad_raw)
    return gradient, [tensor for number in range(len(gradients)) for tensor in gradients[number]]


def unfold_backward(
    net: UNet, raw: Tensor, gradient: Tensor, alpha: Tensor, grad_raw: Tensor, launches: Launches
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of :func:`sundae_ns.compensation.fused.unfold_pixels`, from that of the image ``[H, W, 3]``.

    It writes the gradient of ``raw`` to ``grad_raw``. It returns those of accumulation ``[H, W, 1]``, and of weight
    and bias of the 1 x 1 convolution, float32.
    """
    height, width = gradient.shape[:2]
    rows, columns = raw.shape[-2:]
    outputs = len(net.out.weight)
    gradient = gradient.contiguous()
    values, grad_values = raw.new_empty(rows, columns, raw.shape[1]), raw.new_empty(rows, columns, outputs)
    grad_alpha = torch.zeros_like(alpha, memory_format=torch.contiguous_format)
    layers: list[Argument] = [raw, *last_layers(net), rows, columns]
    images: list[Argument] = [gradient, alpha, pixel_stride(alpha), height, width]
    launches["unfold_backward"](rows * columns, [*layers, *images, grad_raw, values, grad_values, grad_alpha])
    # Sum row by row: as one product it would be a single sum over all pixels, which a GPU cannot parallelise.
    grad_weight = torch.bmm(grad_values.transpose(1, 2), values).sum(dim=0, dtype=torch.float32)
    grad_bias = grad_values.sum(dim=(0, 1), dtype=torch.float32)
    return grad_alpha, grad_weight.reshape(net.out.weight.shape), grad_bias


class _Graphs(NamedTuple):
    """Both directions as CUDA graphs, and the gradients that the second one writes."""

    forward: torch.cuda.CUDAGraph
    backward: torch.cuda.CUDAGraph
    grad_folded: Tensor
    grad_parameters: list[Tensor]


class _Pass(NamedTuple):
    """Buffers of one image size, and the graphs that use them if they are recorded."""

    launches: Launches
    weights: Weights
    tape: Tape
    grad_raw: Tensor
    graphs: _Graphs | None = None


class FusedTraining:
    """Corrections of a network, with gradients for splatted values and parameters.

    A plain object that refers to the network, so that graphs stay out of checkpoints. Call ``backward()`` on a
    correction before computing the next one: passes of one size share their buffers. The gradient of a parameter lies
    in such a buffer until the next pass, which copies it first; a result of ``torch.autograd.grad`` is overwritten by
    then. The network's parameters must stay the same tensors while on one device. A residual network corrects an image.
    """

    def __init__(self, net: UNet, residual: bool) -> None:
        self.net = net
        self.residual = residual
        self._parameters = tuple(_parameters(net))
        self._recorded: dict[tuple[object, ...], _Pass] = {}
        self._can_record = True
        self._passes = 0
        """Number of forward passes; it identifies a pass, since recorded passes of one size share their buffers."""

    def __call__(self, splatted: Tensor, alpha: Tensor, dtype: torch.dtype) -> Tensor:
        """One correction times accumulation, or one image if the network makes it by itself: ``[H, W, 3]`` float32.

        Colours and features ``[H, W, 3 + F]`` and accumulation ``[H, W, 1]`` are float32. ``dtype`` is that of the
        arithmetic, bfloat16.

        Raises:
            BackendError: the kernels cannot be compiled or loaded.
        """
        return cast("Tensor", _Correction.apply(splatted, alpha, self, dtype, *self._parameters))

    def forward(self, splatted: Tensor, alpha: Tensor, dtype: torch.dtype) -> tuple[Tensor, _Pass, int]:
        """The correction, the pass that computed it, and the number of the pass."""
        net = self.net
        launches = head_kernels(splatted.device, dtype, head_options(net, self.residual))
        height, width = splatted.shape[:2]
        key = (height, width, dtype, net.out.weight.data_ptr())
        # Work that is being recorded as part of something larger contains no graph of its own.
        inside = is_recording()
        current = None if inside else self._recorded.get(key)
        folded = folded_input(net, height, width, splatted, dtype) if current is None else current.tape.inputs[0]
        can_record = splatted.is_cuda and self._can_record and not inside and len(self._recorded) < MAX_GRAPHS
        if current is None and can_record:
            try:
                current = self._recorded[key] = self._record(folded.zero_(), launches)
            except BackendError as error:
                _log.warning("the head's training is not recorded and runs kernel by kernel: %s", error)
                self._can_record = False
        fold_pixels(splatted, alpha, net.pixel_unshuffle, self.residual, folded, launches)
        if current is None:
            weights = Weights(net, dtype)
            tape = network(net, weights, folded, launches)
            current = _Pass(launches, weights, tape, torch.empty_like(tape.last))
        elif current.graphs is not None:
            self._release_gradients(current.graphs)
            current.graphs.forward.replay()
        self._passes += 1
        no_base = splatted.new_zeros(height, width, 3)
        return unfold_pixels(net, current.tape.last, no_base, alpha, launches), current, self._passes

    def backward(
        self, current: _Pass, number: int, gradient: Tensor, splatted_channels: int, alpha: Tensor
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Gradients of splatted values ``[H, W, 3 + F]``, accumulation ``[H, W, 1]`` and the parameters."""
        if number != self._passes:
            raise SundaeError("the head has computed another image since: call backward() before the next forward pass")
        net, (launches, weights, tape, grad_raw, graphs) = self.net, current
        grad_alpha, *grad_last = unfold_backward(net, tape.last, gradient, alpha, grad_raw, launches)
        if graphs is None:
            grad_folded, grad_parameters = network_backward(net, weights, tape, grad_raw, launches)
        else:
            self._release_gradients(graphs)  # an earlier backward pass of the same image may have left gradients there
            graphs.backward.replay()
            # Detached tensors without other references: autograd adopts them as gradients without a copy.
            grad_folded, grad_parameters = graphs.grad_folded, [value.detach() for value in graphs.grad_parameters]
        height, width = gradient.shape[:2]
        # Channels that the network does not see have no gradient.
        new = torch.empty if self.residual else torch.zeros
        grad_splatted = new(height, width, splatted_channels, dtype=torch.float32, device=gradient.device)
        rows, columns = grad_folded.shape[-2:]
        padded = grad_folded.shape[1] // net.pixel_unshuffle**2
        sizes = [4 if self.residual else 0, splatted_channels - 3, padded, height, width, rows, columns]
        launches["fold_backward"](rows * columns * padded, [grad_folded, *sizes, grad_splatted, grad_alpha])
        return grad_splatted, grad_alpha, [*grad_parameters, *grad_last]

    def _release_gradients(self, graphs: _Graphs) -> None:
        """Copy gradients of parameters that still lie in the buffers, before a pass overwrites them."""
        for parameter, gradient in zip(self._parameters, graphs.grad_parameters):
            if parameter.grad is not None and parameter.grad.data_ptr() == gradient.data_ptr():
                parameter.grad = parameter.grad.clone()

    def _record(self, folded: Tensor, launches: Launches) -> _Pass:
        weights = Weights(self.net, folded.dtype)
        with warm_up(folded.device):
            tape = network(self.net, weights, folded, launches)
            network_backward(self.net, weights, tape, torch.zeros_like(tape.last), launches)
            del tape

        def forward_pass() -> Tape:
            weights.refresh()
            return network(self.net, weights, folded, launches)

        forward, tape = record(forward_pass, folded.device)
        grad_raw = torch.empty_like(tape.last)
        backward, (grad_folded, grad_parameters) = record(
            lambda: network_backward(self.net, weights, tape, grad_raw, launches),
            folded.device,
            share_memory_with=forward,
        )
        return _Pass(launches, weights, tape, grad_raw, _Graphs(forward, backward, grad_folded, grad_parameters))


class _Correction(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, splatted: Tensor, alpha: Tensor, training: FusedTraining, dtype: torch.dtype, *parameters: Tensor
    ) -> Tensor:
        out, ctx.current, ctx.number = training.forward(splatted, alpha, dtype)
        ctx.training, ctx.channels = training, splatted.shape[2]
        ctx.save_for_backward(alpha)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        (alpha,) = ctx.saved_tensors
        grad_splatted, grad_alpha, grad_parameters = ctx.training.backward(
            ctx.current, ctx.number, gradient, ctx.channels, alpha
        )
        return grad_splatted, grad_alpha, None, None, *grad_parameters


def _parameters(net: UNet) -> Iterator[Tensor]:
    """Parameters in the order of the gradients."""
    for conv in (*convolutions(net), net.out):
        assert conv.bias is not None
        yield conv.weight
        yield conv.bias
