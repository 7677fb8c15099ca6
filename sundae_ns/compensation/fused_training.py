"""The same for training: the head's correction with gradients, by hand, through the same few kernels.

Both directions are recorded as CUDA graphs for each picture size: splatting a pruned field takes so little GPU time that
launching a hundred small kernels one by one from Python would take longer than running them.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

from sundae_ns.compensation.fused import (
    Tape,
    Weights,
    bias_of,
    convolutions,
    fold,
    folded_room,
    last_layers,
    network,
    picture_like,
    pixel_stride,
    unfold,
)
from sundae_ns.compensation.kernels import BACKWARD, FORWARD, PACK, Launches, compiled, definitions
from sundae_ns.compensation.unet import UNet
from sundae_ns.errors import BackendError, SundaeError
from sundae_ns.gpu.cuda_graphs import MAX_SIZES, aside, record

_log = logging.getLogger(__name__)


def network_backward(
    net: UNet, weights: Weights, tape: Tape, gradient: Tensor, launches: Launches
) -> tuple[Tensor, list[Tensor]]:
    """Gradients of :func:`sundae_ns.compensation.fused.network`.

    Args:
        net: the network.
        weights: that the pass was made with.
        tape: of the pass.
        gradient: with respect to the result of the last 3 x 3 convolution, bias added ``[1, width, h, w]`` channels last.
        launches: the kernels.

    Returns:
        With respect to the folded input ``[1, C, h, w]`` channels last, and to weight and bias of each 3 x 3 convolution in
        turn, float32.
    """
    levels = len(net.encoder)
    found: dict[int, tuple[Tensor, Tensor]] = {}

    def convolved(number: int, to_raw: Tensor) -> Tensor:
        x, weight = tape.inputs[number], weights.cast[number]
        to_bias = to_raw.sum(dim=(0, 2, 3), dtype=torch.float32)
        to_x, to_weight, _ = torch.ops.aten.convolution_backward(
            to_raw, x, weight, None, [1, 1], [1, 1], [1, 1], False, [0, 0], 1, [True, True, False]
        )
        channels = convolutions(net)[number].in_channels
        # As the weights lie in memory, or autograd would have to copy them there.
        found[number] = to_weight[:, :channels].float().contiguous(memory_format=torch.channels_last), to_bias
        return cast("Tensor", to_x).contiguous(memory_format=torch.channels_last)

    def double(block: int, to_raw: Tensor) -> Tensor:
        to_middle = convolved(2 * block + 1, to_raw)
        _, channels, rows, columns = to_middle.shape
        middle = tape.inputs[2 * block + 1]
        launches["activate_backward"](to_middle.numel() // PACK, [to_middle, middle, channels, rows * columns])
        return convolved(2 * block, to_middle)

    to_rooms = []
    for step in reversed(range(levels - 1)):
        to_room = double(levels + step, gradient)
        to_rooms.append(to_room)
        coarse = tape.coarse[step]
        _, channels, rows, columns = coarse.shape
        # The coarser block's second convolution is the one before those of this block.
        bias = bias_of(convolutions(net)[2 * (levels + step) - 1])
        gradient = torch.empty_like(coarse)
        launches["upsample_backward"](
            coarse.numel() // PACK,
            [to_room, to_room.shape[1], coarse, bias, channels, rows, columns, gradient],
        )
    gradient = double(levels - 1, gradient)
    for level in reversed(range(levels - 1)):
        to_room, room = to_rooms[level], tape.inputs[2 * (2 * levels - 2 - level)]
        rows, columns = room.shape[-2:]
        channels = gradient.shape[1]
        to_raw = picture_like(gradient, channels, rows, columns)
        launches["pool_backward"](
            to_raw.numel() // PACK, [to_room, room, room.shape[1], gradient, channels, rows, columns, to_raw]
        )
        gradient = double(level, to_raw)
    return gradient, [tensor for number in range(len(found)) for tensor in found[number]]


def unfold_backward(
    net: UNet, raw: Tensor, gradient: Tensor, alpha: Tensor, to_raw: Tensor, launches: Launches
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of :func:`sundae_ns.compensation.fused.unfold`.

    Args:
        net: gives the last layers.
        raw: what the picture was made from ``[1, width, h, w]`` channels last.
        gradient: with respect to the picture, float32 ``[H, W, 3]``.
        alpha: accumulation, float32 ``[H, W, 1]``.
        to_raw: where the gradient with respect to ``raw`` goes, like it.
        launches: the kernels.

    Returns:
        With respect to accumulation ``[H, W, 1]``, and to weight and bias of the 1 x 1 convolution, float32.
    """
    height, width = gradient.shape[:2]
    rows, columns = raw.shape[-2:]
    outputs = len(net.out.weight)
    gradient = gradient.contiguous()
    values, to_values = raw.new_empty(rows, columns, raw.shape[1]), raw.new_empty(rows, columns, outputs)
    to_alpha = torch.zeros_like(alpha, memory_format=torch.contiguous_format)
    launches["unfold_backward"](
        rows * columns,
        [
            *(raw, *last_layers(net), rows, columns),
            *(gradient, alpha, pixel_stride(alpha), height, width),
            *(to_raw, values, to_values, to_alpha),
        ],
    )
    # Row by row and then summed: as one product it would be a single sum over all pixels, which no GPU can share out.
    to_weight = torch.bmm(to_values.transpose(1, 2), values).sum(dim=0, dtype=torch.float32)
    to_bias = to_values.sum(dim=(0, 1), dtype=torch.float32)
    return to_alpha, to_weight.reshape(net.out.weight.shape), to_bias


@dataclass
class _Pass:
    """Buffers of one picture size, and the graphs that read and write them; no graphs where nothing is recorded."""

    weights: Weights
    folded: Tensor
    tape: Tape
    to_raw: Tensor
    to_folded: Tensor | None = None
    to_parameters: list[Tensor] | None = None
    forward: torch.cuda.CUDAGraph | None = None
    backward: torch.cuda.CUDAGraph | None = None


class FusedTraining:
    """Corrections of a network, with gradients for what was splatted and for its parameters.

    A plain object that refers to the network, so that recordings stay out of checkpoints. A correction's gradients must be
    taken before the next one is asked for: recorded passes share their buffers. The gradient of a parameter lies in one of
    these until the next pass, which copies it first; what ``torch.autograd.grad`` returned is overwritten by then.

    Args:
        net: the network; its parameters must stay the same tensors while they stay on their device.
        residual: whether its output corrects a picture, or is one.
        launches: kernels to take in place of those that are compiled for the device.
    """

    def __init__(self, net: UNet, residual: bool, launches: Launches | None = None) -> None:
        self.net = net
        self.residual = residual
        self.launches = launches
        self._parameters = tuple(_parameters(net))
        self._recorded: dict[tuple[object, ...], _Pass] = {}
        self._can_record = True
        self._passes = 0
        """So many pictures were made; recorded passes of one size share their buffers, and only the number tells them apart."""

    def __call__(self, splatted: Tensor, alpha: Tensor, dtype: torch.dtype) -> Tensor:
        """One correction, times accumulation; or one picture, where the network makes it by itself.

        Args:
            splatted: colours and features, float32 ``[H, W, 3 + F]``.
            alpha: accumulation, float32 ``[H, W, 1]``.
            dtype: arithmetic, float16 or bfloat16.

        Returns:
            ``[H, W, 3]`` float32.

        Raises:
            BackendError: the kernels cannot be compiled or loaded here.
        """
        launches = self.launches
        if launches is None:
            launches = compiled(splatted.device, dtype, definitions(self.net, self.residual), FORWARD + BACKWARD)
        return cast("Tensor", _Correction.apply(splatted, alpha, self, dtype, launches, *self._parameters))

    def forward(
        self, splatted: Tensor, alpha: Tensor, dtype: torch.dtype, launches: Launches
    ) -> tuple[Tensor, _Pass, int]:
        """The correction, the pass that made it, and its number."""
        net = self.net
        height, width = splatted.shape[:2]
        key = (height, width, dtype, net.out.weight.data_ptr())
        made = self._recorded.get(key)
        if made is None:
            folded = folded_room(net, height, width, splatted, dtype)
            if splatted.is_cuda and self._can_record and len(self._recorded) < MAX_SIZES:
                try:
                    made = self._recorded[key] = self._record(folded.zero_(), launches)
                except BackendError as error:
                    _log.warning("the head trains kernel by kernel: %s", error)
                    self._can_record = False
            if made is None:
                made = _Pass(Weights(net, dtype), folded, Tape(), Tensor())
        fold(splatted, alpha, net.pixel_unshuffle, self.residual, made.folded, launches)
        if made.forward is not None:
            self._leave(made)
            made.forward.replay()
        else:
            made.tape = network(net, made.weights, made.folded, launches)
            made.to_raw = torch.empty_like(_last(made.tape))
        self._passes += 1
        nothing = splatted.new_zeros(height, width, 3)
        return unfold(net, _last(made.tape), nothing, alpha, launches), made, self._passes

    def backward(
        self, made: _Pass, number: int, gradient: Tensor, splatted_channels: int, alpha: Tensor, launches: Launches
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """With respect to what was splatted ``[H, W, 3 + F]``, accumulation ``[H, W, 1]`` and the parameters."""
        if number != self._passes:
            raise SundaeError("the head's gradients were asked for after its next picture: call backward() before that")
        net = self.net
        to_alpha, *to_last = unfold_backward(net, _last(made.tape), gradient, alpha, made.to_raw, launches)
        if made.backward is not None:
            assert made.to_folded is not None
            assert made.to_parameters is not None
            self._leave(made)  # of an earlier backward pass over the same picture
            made.backward.replay()
            # As tensors that nobody else holds: autograd makes those the parameters' gradients without a copy.
            to_folded, to_parameters = made.to_folded, [gradient.detach() for gradient in made.to_parameters]
        else:
            to_folded, to_parameters = network_backward(net, made.weights, made.tape, made.to_raw, launches)
        height, width = gradient.shape[:2]
        # What the network does not see of it has no gradient.
        new = torch.empty if self.residual else torch.zeros
        to_splatted = new(height, width, splatted_channels, dtype=torch.float32, device=gradient.device)
        rows, columns = to_folded.shape[-2:]
        padded = to_folded.shape[1] // net.pixel_unshuffle**2
        launches["fold_backward"](
            rows * columns * padded,
            [
                *(to_folded, 4 if self.residual else 0, splatted_channels - 3, padded),
                *(height, width, rows, columns, to_splatted, to_alpha),
            ],
        )
        return to_splatted, to_alpha, [*to_parameters, *to_last]

    def _leave(self, made: _Pass) -> None:
        """Copy what parameters still have of an earlier pass: both directions are going to write where it lies."""
        for parameter, gradient in zip(self._parameters, made.to_parameters or (), strict=False):
            if parameter.grad is not None and parameter.grad.data_ptr() == gradient.data_ptr():
                parameter.grad = parameter.grad.clone()

    def _record(self, folded: Tensor, launches: Launches) -> _Pass:
        weights = Weights(self.net, folded.dtype)
        with aside(folded.device):
            tape = network(self.net, weights, folded, launches)
            network_backward(self.net, weights, tape, torch.zeros_like(_last(tape)), launches)
            del tape

        def passed() -> Tape:
            weights.refresh()
            return network(self.net, weights, folded, launches)

        forward, tape = record(passed, folded.device)
        to_raw = torch.empty_like(_last(tape))
        backward, (to_folded, to_parameters) = record(
            lambda: network_backward(self.net, weights, tape, to_raw, launches), folded.device, shares=forward
        )
        return _Pass(weights, folded, tape, to_raw, to_folded, to_parameters, forward, backward)


class _Correction(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        splatted: Tensor,
        alpha: Tensor,
        training: FusedTraining,
        dtype: torch.dtype,
        launches: Launches,
        *parameters: Tensor,
    ) -> Tensor:
        out, ctx.made, ctx.number = training.forward(splatted, alpha, dtype, launches)
        ctx.training, ctx.launches, ctx.channels = training, launches, splatted.shape[2]
        ctx.save_for_backward(alpha)
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        (alpha,) = ctx.saved_tensors
        to_splatted, to_alpha, to_parameters = ctx.training.backward(
            ctx.made, ctx.number, gradient, ctx.channels, alpha, ctx.launches
        )
        return to_splatted, to_alpha, None, None, None, *to_parameters


def _parameters(net: UNet) -> Iterator[Tensor]:
    """In the order in which gradients come."""
    for conv in (*convolutions(net), net.out):
        assert conv.bias is not None
        yield conv.weight
        yield conv.bias


def _last(tape: Tape) -> Tensor:
    assert tape.last is not None
    return tape.last
