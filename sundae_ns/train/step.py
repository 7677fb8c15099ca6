"""The training step: from a view to its loss. Every training runs this one.

nerfstudio asks for images and losses in two calls, and runs the backward pass and the optimizers itself. Captured steps
and fine-tunes run both halves in one call. Several ranks give another source of Gaussians.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
import torch
from pytorch_msssim import SSIM
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.core.camera import Camera, Crop
from sundae_ns.core.metrics import SSIM_WINDOW
from sundae_ns.cuda.kernels import kernels_where_possible
from sundae_ns.cuda.loss import SIGMA, fused_loss, loss_kernels
from sundae_ns.head.head import training_crop
from sundae_ns.rasterize.types import Rasterization
from sundae_ns.scene.render import GaussianSource, RenderSettings, render_view
from sundae_ns.train.state import TrainingState

LEAST_SQUARE = 1e-8  # Added to the mean square, so that its root has a gradient for equal images


@dataclass(frozen=True)
class StepLosses:
    """Terms of the loss of a training step."""

    options: Any  # SundaeModelConfig
    ssim: SSIM  # SSIM of images [1, 3, H, W]
    num_images: int  # Number of training images; 0 if it is not known

    def __call__(
        self,
        state: TrainingState,
        source: GaussianSource,
        rgb: Tensor,
        base: Tensor,
        target: Tensor,
        mask: Tensor | None,
    ) -> dict[str, Tensor]:
        """The terms by name, each ``[]``, for an image ``rgb``, its base colours and the truth, all ``[H, W, 3]``.

        ``state`` says what is enabled at this step; ``source`` has the Gaussians, or a shard of them. ``mask`` ``[H, W,
        1]`` has the pixels that count, None for all.
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
        if state.pruned and options.prior_after_prune > 0:
            # A prior counts once, and the loss is of one image of many.
            weight = options.prior_after_prune / max(self.num_images, 1)
            # Unused Gaussians become transparent and small (equation 10 of 3DGS-MCMC). In a pruned field they would
            # fit what differs between the training images.
            opacities, scales = source.gaussians["opacities"].sigmoid(), source.gaussians["scales"].exp()
            for name, values in (("opacity", opacities), ("scale", scales)):
                losses[f"{name}_loss"] = weight * (values.sum() / (values.shape[1] * source.total))
        return losses


def image_losses(
    image: Tensor, base: Tensor | None, target: Tensor, ssim: SSIM, weight: float, *, squares: bool = False
) -> tuple[Tensor, Tensor | None]:
    """``lambda_1 L1 + lambda_2 (1 - SSIM)`` of the paper for an image, and the L1 loss of its base colours.

    In float32 one kernel computes both (:mod:`sundae_ns.cuda.loss`), and on a CPU SSIM is OpenCV's (:func:`ssim_loss`).
    Images smaller than the window of SSIM are compared by L1 alone. All images are ``[H, W, 3]``; without a ``base``
    its loss is None. ``ssim`` has the window and constants of kernel and loop; ``weight`` is lambda_2, and lambda_1 is
    ``1 - weight``. With ``squares`` the image is compared by the root of the mean square in place of L1.
    """
    root = ((image - target).square().mean() + LEAST_SQUARE).sqrt() if squares else None
    windows = weight > 0 and min(target.shape[:2]) >= SSIM_WINDOW
    single = all(value.dtype == torch.float32 for value in (image, target, base) if value is not None)
    if windows and single and kernels_where_possible(loss_kernels, image.device, "SSIM runs as slower convolutions"):
        loss, of_base = fused_loss(image, target, weight, base, l1_weight=0.0 if squares else 1 - weight)
        return loss if root is None else (1 - weight) * root + loss, of_base
    of_base = None if base is None else (base - target).abs().mean()
    difference = (image - target).abs().mean() if root is None else root
    if not windows:
        return difference, of_base
    on_cpu = single and image.device.type == "cpu"
    dissimilarity = ssim_loss(image, target) if on_cpu else convolved_ssim_loss(image, target, ssim)
    return (1 - weight) * difference + weight * dissimilarity, of_base


_GAUSSIAN = cv2.getGaussianKernel(SSIM_WINDOW, SIGMA, cv2.CV_32F)
_C1, _C2 = 0.01**2, 0.03**2
_WINDOWS = 2 * (slice(SSIM_WINDOW // 2, -(SSIM_WINDOW // 2)),)  # centres of the windows that lie inside the image


def ssim_loss(image: Tensor, target: Tensor) -> Tensor:
    """Mean of 1 - SSIM over the windows inside the image (Wang et al. 2004), as pytorch_msssim; once differentiable.

    ``image`` and ``target`` are float32 ``[H, W, 3]``, both sides at least the window; the target gets no gradient.
    """
    return cast("Tensor", _Dissimilarity.apply(image, target.detach()))


def _filtered(values: Any) -> Any:
    return cv2.sepFilter2D(values, -1, _GAUSSIAN, _GAUSSIAN, borderType=cv2.BORDER_CONSTANT)


class _Dissimilarity(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        x, y = (np.ascontiguousarray(value.detach().numpy()) for value in (image, target))
        mean_x, mean_y, squares, products = (_filtered(value)[_WINDOWS] for value in (x, y, x * x + y * y, x * y))
        both, power = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
        luminance, luminance_max = 2 * both + _C1, power + _C1
        structure, structure_max = 2 * (products - both) + _C2, squares - power + _C2
        inverse = 1 / (luminance_max * structure_max)
        value = luminance * structure * inverse
        if ctx.needs_input_grad[0]:
            # Derivatives by the means of x, x x and x y; covariances are means of products minus products of means.
            by_mean = mean_y * (structure - luminance) * inverse
            by_mean += mean_x * value * (1 / structure_max - 1 / luminance_max)
            padded = np.zeros_like(x)

            def spread(values: Any) -> Any:
                padded[_WINDOWS] = values
                return _filtered(padded)  # the window is symmetric

            gradient = spread(by_mean)
            gradient -= x * spread(value / structure_max)
            gradient += y * spread(luminance * inverse)
            gradient *= np.float32(-2 / value.size)
            ctx.save_for_backward(torch.from_numpy(gradient))
        return image.new_tensor(1 - value.mean(dtype=np.float64))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None]:
        return grad_loss * ctx.saved_tensors[0], None


def convolved_ssim_loss(image: Tensor, target: Tensor, ssim: SSIM) -> Tensor:
    """As :func:`ssim_loss`, by convolutions, on any device and of any dtype."""
    ssim.win = ssim.win.to(target.device)  # once; each call would copy it and wait
    # Contiguous planes: convolutions of a large image with interleaved colours take much longer.
    similarity: Tensor = ssim(*(value.permute(2, 0, 1)[None].contiguous() for value in (image, target)))
    return 1 - similarity


@dataclass(frozen=True)
class StepInputs:
    """What a step trains on."""

    camera: Camera
    target: Tensor  # The true image over the background [H, W, 3]
    mask: Tensor | None  # Pixels that count, float [H, W, 1]; None for all
    background: Tensor  # Colour [3]
    crop: Crop | None = None  # The part of the training image that is shown; None for the whole image
    rates: Tensor | None = None  # Learning rates of the groups of parameters [G]; None where the optimizer holds them

    def _tensors(self) -> list[Tensor]:
        tensors = (self.camera.viewmat, self.camera.K, self.target, self.background, self.mask, self.rates)
        return [value.detach() for value in tensors if value is not None]

    def clone(self) -> StepInputs:
        """A copy, so that a recording reads it where it stays."""

        def copy(value: Tensor | None) -> Any:
            return None if value is None else value.detach().clone(memory_format=torch.contiguous_format)

        camera = self.camera._replace(viewmat=copy(self.camera.viewmat), K=copy(self.camera.K))
        tensors = {name: copy(getattr(self, name)) for name in ("target", "mask", "background", "rates")}
        return replace(self, camera=camera, **tensors)

    def copy_to(self, other: StepInputs) -> None:
        """Write these into the inputs of a recording."""
        torch._foreach_copy_(other._tensors(), self._tensors())


@dataclass(frozen=True)
class StepResult:
    """Images and losses of a step; the next step overwrites them."""

    images: dict[str, Tensor]  # rgb, base_rgb and accumulation, each [H, W, C]
    losses: dict[str, Tensor]  # Terms of the loss []
    loss: Tensor  # Their sum []


class StepResolution(NamedTuple):
    """Form of the training images at one step: a function of the step and the options."""

    step: int
    downscale: int  # Divisor of the sides of the images
    window_pixels: int  # Most pixels of an image; larger images are trained on by a random window. 0 for no limit.
    mirror: bool = False  # Whether half of the steps mirror their image


def training_part(state: TrainingState, camera: Camera, at: StepResolution) -> tuple[Camera, Crop | None]:
    """The part of a camera that a step shows, and its crop; None for the whole image.

    The state remembers the focal lengths that the head is trained on.
    """
    if state.head_enabled and at.downscale == 1:
        low, high = state.trained_focal or (camera.focal, camera.focal)
        state.trained_focal = (min(low, camera.focal), max(high, camera.focal))
    crop = training_crop(camera.width, camera.height, at.window_pixels, seed=at.step, mirror=at.mirror)
    return camera if crop is None else camera.cut(crop), crop


def training_step(
    source: GaussianSource, state: TrainingState, losses: StepLosses, inputs: StepInputs, settings: RenderSettings
) -> tuple[Tensor, Rasterization, StepResult]:
    """The loss ``[]`` of Gaussians with its graph, the rasteriser's result, and the detached result of the step."""
    with torch.enable_grad():
        images, splatted = render_view(source, inputs.camera, inputs.background, settings, depth=False)
        rgb, base = images["rgb"], images["base_rgb"]
        terms = losses(state, source, rgb, base, inputs.target, inputs.mask)
        loss = functools.reduce(torch.add, terms.values())
    kept = {name: images[name].detach() for name in ("rgb", "base_rgb", "accumulation")}
    return loss, splatted, StepResult(kept, {name: value.detach() for name, value in terms.items()}, loss.detach())
