"""Terms of the loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from pytorch_msssim import SSIM
from torch import Tensor

from sundae_ns.gpu.kernels import kernels_where_possible
from sundae_ns.gpu.loss import SSIM_WINDOW, fused_loss, loss_kernels
from sundae_ns.training.cpu_loss import ssim_loss
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.options import ModelOptions

LEAST_SQUARE = 1e-8
"""Added to the mean square, so that its root has a gradient for equal images."""


@dataclass(frozen=True)
class StepLosses:
    """Terms of the loss of a training step."""

    options: ModelOptions
    """Options of the model."""
    ssim: SSIM
    """SSIM of images ``[1, 3, H, W]``."""
    num_images: int
    """Number of training images; 0 if it is not known."""

    def __call__(
        self,
        state: FieldState,
        params: Mapping[str, Tensor],
        rgb: Tensor,
        base: Tensor,
        target: Tensor,
        mask: Tensor | None,
        count: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """The terms by name, each ``[]``.

        Args:
            state: says what is enabled at this step.
            params: trained parameters, with logits ``opacities`` ``[N, 1]`` and logarithms ``scales`` ``[N, 3]``.
            rgb: the image ``[H, W, 3]``.
            base: its base colours ``[H, W, 3]``.
            target: the truth ``[H, W, 3]``.
            mask: pixels that count ``[H, W, 1]``; None for all.
            count: number of primitives ``[]``, where further rows are transparent and without width; None for N.
        """
        if mask is not None:
            target, rgb, base = target * mask, rgb * mask, base * mask
        options = self.options
        compared = base if state.head_enabled and options.base_loss_weight > 0 else None
        squares = options.loss_after_prune == "rms" and state.pruned
        main_loss, base_loss = image_losses(rgb, compared, target, self.ssim, options.ssim_lambda, squares=squares)
        losses = {"main_loss": main_loss}
        if base_loss is not None:
            losses["base_loss"] = options.base_loss_weight * base_loss
        weight = self.prior_weight(state)
        if weight > 0:
            # Unused primitives become transparent and small (equation 10 of 3DGS-MCMC). In a pruned field they would
            # fit what differs between the training images.
            for name, values in (("opacity", params["opacities"].sigmoid()), ("scale", params["scales"].exp())):
                mean = values.mean() if count is None else values.sum() / (values.shape[1] * count)
                losses[f"{name}_loss"] = weight * mean
        return losses

    def prior_weight(self, state: FieldState) -> float:
        """Weight of opacities and scales at this step."""
        # A prior counts once, and the loss is of one image: its weight falls with their number.
        return self.options.prior_after_prune / max(self.num_images, 1) if state.pruned else 0.0


def image_losses(
    image: Tensor, base: Tensor | None, target: Tensor, ssim: SSIM, weight: float, *, squares: bool = False
) -> tuple[Tensor, Tensor | None]:
    """``lambda_1 L1 + lambda_2 (1 - SSIM)`` of the paper for an image, and the L1 loss of its base colours.

    In float32 one kernel computes both (:mod:`sundae_ns.gpu.loss`), and on a CPU SSIM is
    OpenCV's (:mod:`sundae_ns.training.cpu_loss`). Images smaller than the window of SSIM are compared by L1 alone.

    Args:
        image: rendered image ``[H, W, 3]``, differentiable.
        base: base colours ``[H, W, 3]``, differentiable; None for none.
        target: the truth ``[H, W, 3]``.
        ssim: SSIM of images ``[1, 3, H, W]``, with the window and constants of kernel and loop.
        weight: lambda_2; lambda_1 is ``1 - weight``.
        squares: whether the image is compared by the root of the mean square in place of L1.

    Returns:
        Both losses; the second is None without base colours.
    """
    if not squares:
        return _losses(image, base, target, ssim, weight, 1 - weight)
    root = ((image - target).square().mean() + LEAST_SQUARE).sqrt()
    if weight == 0 or min(target.shape[:2]) < SSIM_WINDOW:
        return root, None if base is None else (base - target).abs().mean()
    rest, of_base = _losses(image, base, target, ssim, weight, 0.0)
    return (1 - weight) * root + rest, of_base


def _losses(
    image: Tensor, base: Tensor | None, target: Tensor, ssim: SSIM, weight: float, l1_weight: float
) -> tuple[Tensor, Tensor | None]:
    """``l1_weight L1 + weight (1 - SSIM)`` of an image, and the L1 loss of its base colours."""
    single = all(one.dtype == torch.float32 for one in (image, target, base) if one is not None)
    large = min(target.shape[:2]) >= SSIM_WINDOW
    if weight > 0 and large and single:
        if image.is_cuda and kernels_where_possible(loss_kernels, image.device, "SSIM runs as slower convolutions"):
            return fused_loss(image, target, weight, base, l1_weight=l1_weight)
    of_base = None if base is None else (base - target).abs().mean()
    if weight == 0 or not large:
        return (image - target).abs().mean(), of_base
    if single and image.device.type == "cpu":
        return l1_weight * (image - target).abs().mean() + weight * ssim_loss(image, target), of_base
    return convolved_loss(image, target, ssim, weight, l1_weight), of_base


def convolved_loss(image: Tensor, target: Tensor, ssim: SSIM, weight: float, l1_weight: float | None = None) -> Tensor:
    """``l1_weight L1 + weight (1 - SSIM)`` by convolutions, on any device; ``l1_weight`` is ``1 - weight`` if None."""
    l1_weight = 1 - weight if l1_weight is None else l1_weight
    ssim.win = ssim.win.to(target.device)  # once; each call would copy it and wait
    # Contiguous planes: convolutions of a large image with interleaved colours take much longer.
    planes, truth = (one.permute(2, 0, 1)[None].contiguous() for one in (image, target))
    similarity: Tensor = ssim(planes, truth)
    return l1_weight * (image - target).abs().mean() + weight * (1 - similarity)
