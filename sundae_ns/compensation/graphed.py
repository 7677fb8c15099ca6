"""Replays a network as one CUDA graph, in training and for pictures that are only looked at.

Splatting a pruned field takes so little GPU time that launching the head's many small kernels one by one from Python
would take longer than running them. Recording them once a picture size removes that cost; the numbers are the same.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

MAX_SIZES = 4
"""Recordings kept at a time: each holds its own activations. Captures with more picture sizes run the rest unrecorded."""


RECORD_AT = 3
"""A size is recorded when it is shown for this time in a row: a viewer that is being resized never shows one twice."""


class _Autocast(nn.Module):
    """The network under autocast, as a module of its own, because recording patches the module that it records."""

    def __init__(self, net: nn.Module, dtype: torch.dtype) -> None:
        super().__init__()
        self.net = net
        self.dtype = dtype

    def forward(self, image: Tensor) -> Tensor:
        # A recording must not share casts of the weights with what runs outside of it.
        with torch.autocast("cuda", dtype=self.dtype, enabled=self.dtype != torch.float32, cache_enabled=False):
            return self.net(image)


class GraphedTraining:
    """Forward and backward passes of ``net``, recorded once for each input shape.

    A plain object that refers to the network, so that recordings stay out of checkpoints.

    Args:
        net: the network; its parameters must stay the same tensors.
        dtype: arithmetic of the network.
    """

    def __init__(self, net: nn.Module, dtype: torch.dtype) -> None:
        self.net = net
        self.dtype = dtype
        self._recorded: dict[tuple[int, ...], Callable[[Tensor], Tensor]] = {}

    def __call__(self, image: Tensor) -> Tensor | None:
        """The network's output for ``[1, C, H, W]`` on CUDA; None if there is no room for another recording."""
        shape = tuple(image.shape)
        if shape not in self._recorded:
            if len(self._recorded) >= MAX_SIZES:
                return None
            sample = torch.zeros_like(image, requires_grad=True)
            module = _Autocast(self.net, self.dtype).train()
            recorded = torch.cuda.make_graphed_callables(module, (sample,))
            self._recorded[shape] = cast("Callable[[Tensor], Tensor]", recorded)
        return self._recorded[shape](image)


class _Recording(NamedTuple):
    graph: torch.cuda.CUDAGraph
    image: Tensor
    """Where the graph reads."""
    out: Tensor
    """Where it writes."""


class GraphedInference:
    """The forward pass of ``net`` without gradients, recorded for each input shape that stays.

    Weights are read where they are, so that a recording made while training goes on shows the newest.

    Args:
        net: the network; its parameters must stay the same tensors.
    """

    def __init__(self, net: nn.Module) -> None:
        self.net = net
        self._recorded: OrderedDict[tuple[object, ...], _Recording] = OrderedDict()
        self._last: tuple[object, ...] | None = None
        self._in_a_row = 0

    def __call__(self, image: Tensor, dtype: torch.dtype) -> Tensor | None:
        """The network's output for ``[1, C, H, W]`` on CUDA, valid until the next call; None if this size is not recorded.

        Args:
            image: the input, of any floating type.
            dtype: arithmetic of the network.
        """
        key = (tuple(image.shape), dtype, image.device)
        self._in_a_row = self._in_a_row + 1 if key == self._last else 1
        self._last = key
        if key not in self._recorded:
            if self._in_a_row < RECORD_AT:
                return None
            if len(self._recorded) >= MAX_SIZES:
                self._recorded.popitem(last=False)
            self._recorded[key] = self._record(image, dtype)
        self._recorded.move_to_end(key)
        recording = self._recorded[key]
        recording.image.copy_(image)
        recording.graph.replay()
        return recording.out

    def _record(self, image: Tensor, dtype: torch.dtype) -> _Recording:
        module = _Autocast(self.net, dtype)
        held = image.to(dtype, memory_format=torch.channels_last, copy=True)
        # What runs first on a stream of its own allocates and chooses kernels, neither of which can be recorded.
        side = torch.cuda.Stream(image.device)
        side.wait_stream(torch.cuda.current_stream(image.device))
        with torch.cuda.stream(side):
            module(held)
        torch.cuda.current_stream(image.device).wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        # A training loop beside a viewer may allocate meanwhile; only this thread's work belongs to the recording.
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            out = module(held)
        return _Recording(graph, held, out)
