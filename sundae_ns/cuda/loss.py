"""``(1 - weight) L1 + weight (1 - SSIM)`` of an image, L1 of its base colours, and gradients: one GPU kernel each.

Built from convolutions, SSIM reads and writes the image dozens of times. In ``csrc/loss.cu`` a block of threads keeps a
tile of both images in shared memory, and filters it there by rows and columns. It writes only three derivatives, which
the backward pass filters once more.
"""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.core.metrics import SSIM_WINDOW
from sundae_ns.cuda.kernels import Launch, load_kernels

SIGMA = 1.5  # Standard deviation of the window, pixels

_TILE_WIDTH, _TILE_HEIGHT, _THREADS = 32, 16, 256

_window = [math.exp(-((k - SSIM_WINDOW // 2) ** 2) / (2 * SIGMA**2)) for k in range(SSIM_WINDOW)]
_WEIGHTS = ",".join(f"{weight / sum(_window):.9e}f" for weight in _window)

OPTIONS = (
    f"-DWINDOW={SSIM_WINDOW}",
    *(f"-DTILE_WIDTH={_TILE_WIDTH}", f"-DTILE_HEIGHT={_TILE_HEIGHT}", f"-DTHREADS={_THREADS}"),
    f"-DWEIGHTS={_WEIGHTS}",
)
"""Compiler options of ``loss.cu``."""


def loss_kernels(device: torch.device) -> dict[str, Launch]:
    """The kernels for a CUDA device; see :func:`.load_kernels`."""
    return load_kernels("loss.cu", ("compare", "compare_backward"), OPTIONS, device, _THREADS)


def fused_loss(
    image: Tensor, target: Tensor, weight: float, base: Tensor | None = None, l1_weight: float | None = None
) -> tuple[Tensor, Tensor | None]:
    """``(1 - weight) L1 + weight (1 - SSIM)`` of an image, and L1 of its base colours or None; once differentiable.

    L1 is the mean over all values, with ``l1_weight`` if it is given. SSIM is pytorch_msssim's, over windows inside the
    image, with a data range of 1. All images are float32 on a CUDA device ``[H, W, 3]``, both sides at least
    :data:`SSIM_WINDOW`; the target gets no gradient. ``BackendError`` if the kernels cannot be compiled or loaded.
    """
    kinds = {(each.shape, each.dtype) for each in (image, target, base) if each is not None}
    assert kinds == {(target.shape, torch.float32)}
    weights = (1 - weight if l1_weight is None else l1_weight, weight)
    return cast("tuple[Tensor, Tensor | None]", _Loss.apply(image, base, target.detach(), weights))


def _threads(image: Tensor) -> int:
    """Number of threads: one block per tile."""
    height, width = image.shape[:2]
    return -(-width // _TILE_WIDTH) * -(-height // _TILE_HEIGHT) * _THREADS


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, image: Tensor, base: Tensor | None, target: Tensor, weights: tuple[float, float]
    ) -> tuple[Tensor, Tensor | None]:
        image, target = image.contiguous(), target.contiguous()
        base = None if base is None else base.contiguous()
        height, width, channels = image.shape
        windows = (height - SSIM_WINDOW + 1) * (width - SSIM_WINDOW + 1) * channels
        derivatives = image.new_empty(3 * windows) if any(ctx.needs_input_grad) else None
        losses = image.new_empty(_threads(image) // _THREADS)
        base_losses = None if base is None else torch.empty_like(losses)
        scales = (weights[0] / image.numel(), weights[1] / windows, 1 / image.numel())
        arguments = [height, width, image, base, target, *scales, derivatives, losses, base_losses]
        loss_kernels(image.device)["compare"](_threads(image), arguments)
        ctx.save_for_backward(image, base, target, derivatives)
        ctx.scales = scales
        return losses.sum(), None if base_losses is None else base_losses.sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor, grad_base_loss: Tensor | None) -> tuple[Tensor | None, ...]:
        image, base, target, derivatives = ctx.saved_tensors
        grad_image, grad_base = torch.empty_like(image), None if base is None else torch.empty_like(base)
        height, width, _ = image.shape
        arguments = [height, width, image, base, target, *ctx.scales, derivatives, grad_loss, grad_base_loss]
        loss_kernels(image.device)["compare_backward"](_threads(image), [*arguments, grad_image, grad_base])
        return grad_image, grad_base, None, None
