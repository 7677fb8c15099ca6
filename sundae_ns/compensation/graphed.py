"""Replays a network's training as one CUDA graph.

Splatting a pruned field takes so little GPU time that launching the head's many small kernels one by one from Python
would take longer than running them. Recording them once a picture size removes that cost; the numbers are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor, nn

MAX_SIZES = 4
"""Recordings kept at a time: each holds its own activations. Captures with more picture sizes run the rest unrecorded."""


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
