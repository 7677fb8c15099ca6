"""Colours of primitives as seen from a place, and their gradients: one kernel each way, on torch's current stream.

gsplat 1.4 launches its own harmonics on CUDA's default stream. A CUDA graph records another stream, so recorded work
would lack the colours. These kernels also read the coefficients where the field holds them, without a copy that joins
both parameters. The formulas are those of :mod:`sundae_ns.rasterization.harmonics`.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor

from sundae_ns.errors import SundaeError
from sundae_ns.gpu.nvrtc import Argument, Launch, load_kernels

PER_BLOCK = 128
"""Primitives of a block of threads, which reads and writes their coefficients as one piece."""

MOST_REST = 72
"""Numbers of a primitive's coefficients beyond the first, of SH degree 4."""

OPTIONS = (f"-DPER_BLOCK={PER_BLOCK}", f"-DMOST_REST={MOST_REST}")
"""Compiler options of ``colors.cu``."""


def harmonic_colors(degree: int, means: Tensor, center: Tensor, features_dc: Tensor, features_rest: Tensor) -> Tensor:
    """See :func:`sundae_ns.rasterization.harmonic_colors`; differentiable once, but not in ``center``.

    All tensors are float32 on a CUDA device.

    Raises:
        BackendError: the kernels cannot be compiled or loaded.
    """
    return cast("Tensor", _Colors.apply(degree, means, center, features_dc, features_rest))


def _kernels(device: torch.device) -> dict[str, Launch]:
    return load_kernels("colors.cu", ("harmonic_colors", "harmonic_colors_backward"), OPTIONS, device, PER_BLOCK)


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, degree: int, means: Tensor, center: Tensor, dc: Tensor, rest: Tensor
    ) -> Tensor:
        means, center, dc, rest = (value.contiguous() for value in (means, center, dc, rest))
        colors = torch.empty_like(means)
        place: list[Argument] = [len(means), degree, means, center, int(center.ndim > 1)]
        _kernels(means.device)["harmonic_colors"](colors.numel(), [*place, dc, rest, rest.shape[1], colors])
        ctx.save_for_backward(means, center, dc, rest, colors)
        ctx.degree = degree
        return colors

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        if torch.is_grad_enabled():  # create_graph=True: the kernel would be missing from that graph
            raise SundaeError("these harmonics have no second derivative; use the reference rasteriser")
        means, center, dc, rest, colors = ctx.saved_tensors
        grads = [torch.empty_like(value) for value in (means, dc, rest)]
        place: list[Argument] = [len(means), ctx.degree, means, center, int(center.ndim > 1)]
        threads = -(-len(means) // PER_BLOCK) * PER_BLOCK
        arguments: list[Argument] = [*place, rest, rest.shape[1], colors, gradient.contiguous(), *grads]
        _kernels(means.device)["harmonic_colors_backward"](threads, arguments)
        return None, grads[0], None, grads[1], grads[2]
