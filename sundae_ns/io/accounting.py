"""Stored bytes of the Gaussians and of the head."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from sundae_ns.head.head import CompensationHead, HeadConfig


def bytes_of(params: Mapping[str, Tensor]) -> int:
    """Bytes of the parameters of Gaussians in fp32, feature vectors included, for any dtype in memory."""
    return sum(value.numel() for value in params.values()) * 4


def bytes_of_module(module: nn.Module) -> int:
    """Bytes of a module's parameters and buffers, each in its own dtype; a shared tensor counts once."""
    return sum(tensor.numel() * tensor.element_size() for tensor in [*module.parameters(), *module.buffers()])


def stored_bytes(params: Mapping[str, Tensor], head: HeadConfig | None) -> int:
    """Bytes of Gaussians and their head, whose weights are not allocated; the one count that decides in training."""
    if head is None or head.mode == "off":
        return bytes_of(params)
    with torch.device("meta"):
        return bytes_of(params) + bytes_of_module(CompensationHead(head))
