"""CUDA kernels between the head's convolutions, forward and backward, and their compilation.

Layer by layer, most of the head's time goes to reading and writing images: bias, activation, pooling, upsampling and
concatenation are a pass each. Here one pass does everything between two convolutions, and writes its result where the
next convolution reads it.

The source is plain C++ except for the thread indices and conversions, so the tests compile the same source for the CPU.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn

from sundae_ns.compensation.unet import SLOPE, UNet
from sundae_ns.gpu.nvrtc import Launch, load_kernels

PACK = 8
"""Channels that a thread moves at once, 16 bytes; images are padded to a multiple, which tensor cores need too."""

_FORWARD = ("fold", "activate", "pool", "upsample", "unfold")

KERNELS = (*_FORWARD, *(f"{name}_backward" for name in _FORWARD), "sum_pixels")
"""Names of the kernels of ``head.cu``."""

_TYPES = {torch.float16: "-DFP16", torch.bfloat16: "-DBF16"}

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

    Args:
        device: CUDA device.
        dtype: dtype of images between the convolutions, float16 or bfloat16.
        options: see :func:`head_options`.

    Raises:
        BackendError: the kernels cannot be compiled or loaded.
    """
    return load_kernels("head.cu", KERNELS, (_TYPES[dtype], *options), device)
