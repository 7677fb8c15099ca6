"""1 - SSIM on a CPU by OpenCV's separable filters, with its gradient."""

from __future__ import annotations

from typing import Any, cast

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.gpu.loss import SIGMA, SSIM_WINDOW

_GAUSSIAN = cv2.getGaussianKernel(SSIM_WINDOW, SIGMA, cv2.CV_32F)
_C1, _C2 = 0.01**2, 0.03**2
_HALF = SSIM_WINDOW // 2
_WINDOWS = (slice(_HALF, -_HALF), slice(_HALF, -_HALF))  # centres of the windows that lie inside the image


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
