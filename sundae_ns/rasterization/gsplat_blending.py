"""Front-to-back blending of gsplat's tile lists, and its gradients: one kernel each way, for training.

The arithmetic and thresholds are gsplat's. Its backward pass sums each value of a primitive over the pixels of a warp
by five exchanges, and adds the sums one by one. Here the lanes of a warp halve the values while they exchange them: 32
values take 31 exchanges in place of 160, and all are added at once. The gradient of alpha needs the sum over all later
primitives only as a product with the pixel's gradient. So a thread keeps one number for it, not one for each channel.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sundae_ns.errors import SundaeError
from sundae_ns.gpu.nvrtc import Argument, load_kernels
from sundae_ns.rasterization.compositing import MAX_ALPHA, MIN_TRANSMITTANCE
from sundae_ns.rasterization.gsplat_tiles import ROUNDING, TILE, GsplatLists
from sundae_ns.rasterization.tiles import MIN_ALPHA

THREADS = TILE * TILE
"""Threads of a block: one for each pixel of a tile."""

LANES = 32
"""Threads of a warp."""


def blending_options(channels: int, *, absgrad: bool) -> tuple[str, ...]:
    """Compiler options of ``blending.cu``; with ``absgrad`` it also sums absolute gradients of the centres."""
    values = channels + (8 if absgrad else 6)
    numbers = {
        "TILE": TILE,
        "THREADS": THREADS,
        "LANES": LANES,
        "CHANNELS": channels,
        "PADDED": -(-channels // 4) * 4,
        "VALUES": values,
        "SLOTS": 1 << (values - 1).bit_length(),
        "ABSOLUTE": int(absgrad),
    }
    limits = {
        "MAX_ALPHA": MAX_ALPHA,
        "MIN_ALPHA": MIN_ALPHA,
        "MIN_TRANSMITTANCE": MIN_TRANSMITTANCE,
        "ROUNDING": ROUNDING,
    }
    return (
        *(f"-D{name}={number}" for name, number in numbers.items()),
        *(f"-D{name}={limit:.9e}f" for name, limit in limits.items()),
    )


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, lists: GsplatLists, absgrad: bool
    ) -> tuple[Tensor, Tensor]:
        width, height = lists.width, lists.height
        field = [value.contiguous() for value in (means2d, conics, colors, opacities)]
        image = colors.new_empty(1, height, width, colors.shape[-1])
        alphas = colors.new_empty(1, height, width, 1)
        lefts = torch.empty_like(alphas)  # 1 - alpha would round them to multiples of 6e-8
        stops = torch.empty(height, width, dtype=torch.int32, device=colors.device)
        tiles = -(-width // TILE) * -(-height // TILE)
        ctx.place = [width, height, tiles, lists.starts.numel(), len(lists.primitives), lists.starts, lists.primitives]
        options = blending_options(colors.shape[-1], absgrad=absgrad)
        ctx.kernels = load_kernels("blending.cu", ("blend", "blend_backward"), options, colors.device, THREADS)
        ctx.kernels["blend"](tiles * THREADS, [*ctx.place, *field, image, alphas, lefts, stops])
        ctx.save_for_backward(means2d, *field, lefts, stops)
        ctx.absgrad = absgrad
        return image, alphas

    @staticmethod
    def backward(  # type: ignore[override]
        ctx: Any, grad_image: Tensor, grad_alphas: Tensor
    ) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True: the kernel would be missing from that graph
            raise SundaeError("this blending has no second derivative; use the reference rasteriser")
        centers, *saved = ctx.saved_tensors
        grads = [torch.zeros_like(value) for value in saved[:4]]
        absolute = torch.zeros_like(saved[0]) if ctx.absgrad else None
        arguments: list[Argument] = [*ctx.place, *saved, grad_image.contiguous(), grad_alphas.contiguous()]
        ctx.kernels["blend_backward"](ctx.place[2] * THREADS, [*arguments, *grads, absolute])
        if ctx.absgrad:
            centers.absgrad = absolute
        return *grads, None, None


blend = _Blend.apply
"""Blend splats to an image ``[1, H, W, C]`` and its alpha ``[1, H, W, 1]``; once differentiable.

It takes centres ``[1, N, 2]`` in pixels, conics ``[1, N, 3]``, colours ``[1, N, C]``, opacities ``[1, N]``, the tile
lists, and ``absgrad``. Tensors are float32 on a CUDA device. Lists of tiles outside the image are ignored. With
``absgrad`` the backward pass sets ``absgrad`` ``[1, N, 2]`` of the centres: the absolute gradients of the pixels,
summed (AbsGS).
It raises BackendError if the kernels cannot be compiled or loaded.
"""
