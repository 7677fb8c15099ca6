"""``(1 - weight) L1 + weight (1 - SSIM)`` of an image, L1 of its base colours, and gradients: one compiled loop each.

The CPU's twin of :mod:`sundae_ns.gpu.fused_loss`. A row of an image ``[H, W, 3]`` is one run of interleaved colours, so
a window takes every third number of it. Loops run over rows, each with a sum of its own, so results do not depend on
the number of threads. Importing this module imports numba.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.gpu.fused_loss import SIGMA, SSIM_WINDOW
from sundae_ns.rasterization.cpu.lanes import WIDTH, broadcast, fma, load, select, store, zeros
from sundae_ns.rasterization.cpu.parallel import as_array, compiled, inlined, parallel_for

_COLORS = 3
_REACH = _COLORS * (SSIM_WINDOW - 1)  # numbers from the first pixel of a window to its last
_C1, _C2 = 0.01**2, 0.03**2
_MIN_PER_THREAD = 16  # rows

_gaussian = [math.exp(-((k - SSIM_WINDOW // 2) ** 2) / (2 * SIGMA**2)) for k in range(SSIM_WINDOW)]
_WEIGHTS = np.array([value / sum(_gaussian) for value in _gaussian], np.float32)


def compiled_loss(
    image: Tensor, target: Tensor, weight: float, base: Tensor | None = None, l1_weight: float | None = None
) -> tuple[Tensor, Tensor | None]:
    """:func:`sundae_ns.gpu.fused_loss.fused_loss` on a CPU; once differentiable, without checks of the images."""
    weights = (1 - weight if l1_weight is None else l1_weight, weight)
    return cast("tuple[Tensor, Tensor | None]", _Loss.apply(image, base, target.detach(), weights))


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, base: Tensor | None, target: Tensor, weights: tuple[float, float]
    ) -> tuple[Tensor, Tensor | None]:
        height, width, _ = image.shape
        windows_high, windows_wide = height - SSIM_WINDOW + 1, _COLORS * (width - SSIM_WINDOW + 1)
        arrays = [as_array(value) for value in (image, image if base is None else base, target)]
        derivatives = np.empty((3, windows_high, _whole_lanes(windows_wide)), np.float32)
        sums = np.empty((height, 3))
        parallel_for(_compare, height, _WEIGHTS, *arrays, derivatives, sums, min_per_thread=_MIN_PER_THREAD)
        values, windows = _COLORS * height * width, windows_high * windows_wide
        difference, dissimilarity, of_base = sums.sum(axis=0)
        ctx.save_for_backward(image, base, target)
        ctx.derivatives, ctx.scales = derivatives, (weights[0] / values, weights[1] / windows, 1 / values)
        loss = ctx.scales[0] * difference + ctx.scales[1] * dissimilarity
        return image.new_tensor(loss), None if base is None else image.new_tensor(of_base / values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor, grad_of_base: Tensor | None) -> tuple[Tensor | None, ...]:
        image, base, target = ctx.saved_tensors
        grads = [
            torch.empty_like(image, memory_format=torch.contiguous_format) for _ in range(1 if base is None else 2)
        ]
        arrays = [as_array(value) for value in (image, image if base is None else base, target)]
        outputs = [as_array(value) for value in (grads[0], grads[-1])]
        l1_scale, ssim_scale, base_scale = ctx.scales
        slopes = np.array([float(grad_loss) * l1_scale, -float(grad_loss) * ssim_scale, 0.0], np.float32)
        if grad_of_base is not None:
            slopes[2] = float(grad_of_base) * base_scale
        arguments = (_WEIGHTS, *arrays, ctx.derivatives, slopes, base is not None, *outputs)
        parallel_for(_compare_backward, len(image), *arguments, min_per_thread=_MIN_PER_THREAD)
        return grads[0], None if base is None else grads[1], None, None


@compiled
def _whole_lanes(count: int) -> int:
    """The smallest multiple of the lanes that is at least ``count``."""
    return (count + WIDTH - 1) // WIDTH * WIDTH


@inlined
def _filtered(weights: Any, values: Any, place: int, step: int) -> Any:
    """Weighted sum of lanes of ``values`` at ``place``, ``place + step``, ..."""
    total = zeros(values)
    for k in range(SSIM_WINDOW):
        total = fma(broadcast(weights, k), load(values, place + k * step), total)
    return total


@compiled
def _compare(
    begin: int, end: int, weights: Any, image: Any, base: Any, target: Any, derivatives: Any, sums: Any
) -> None:
    """Sum up the absolute differences of each row, 1 - SSIM of the windows that begin in it, and those of base colours.

    It writes the derivatives of a window's SSIM with respect to its means of x, x x and x y.
    """
    height, length = image.shape[0], _COLORS * image.shape[1]
    windows_high, windows_wide, stride = height - SSIM_WINDOW + 1, length - _REACH, derivatives.shape[2]
    # Lanes beyond the last window read beyond the row.
    room = stride + _REACH
    partial, similarity = np.zeros(5 * room, np.float32), np.empty(stride, np.float32)
    for row in range(begin, end):
        difference = base_difference = 0.0
        for column in range(image.shape[1]):
            for color in range(_COLORS):
                truth = target[row, column, color]
                difference += abs(image[row, column, color] - truth)
                base_difference += abs(base[row, column, color] - truth)
        sums[row, 0], sums[row, 1], sums[row, 2] = difference, 0.0, base_difference
        if row >= windows_high:
            continue
        for block in range(0, length, WIDTH):
            place = min(block, length - WIDTH)  # the last lanes overlap with those before
            x = y = xx = yy = xy = zeros(weights)
            for k in range(SSIM_WINDOW):
                weight, at = broadcast(weights, k), (row + k) * length + place
                a, b = load(image, at), load(target, at)
                weighted_a, weighted_b = weight * a, weight * b
                x, y = x + weighted_a, y + weighted_b
                xx, yy, xy = fma(weighted_a, a, xx), fma(weighted_b, b, yy), fma(weighted_a, b, xy)
            store(partial, place, x)
            store(partial, room + place, y)
            store(partial, 2 * room + place, xx)
            store(partial, 3 * room + place, yy)
            store(partial, 4 * room + place, xy)
        for place in range(0, windows_wide, WIDTH):
            mean_x = _filtered(weights, partial, place, _COLORS)
            mean_y = _filtered(weights, partial, room + place, _COLORS)
            both, squares = mean_x * mean_y, fma(mean_x, mean_x, mean_y * mean_y)
            luminance, luminance_max = 2.0 * both + _C1, squares + _C1
            structure = 2.0 * (_filtered(weights, partial, 4 * room + place, _COLORS) - both) + _C2
            power = _filtered(weights, partial, 2 * room + place, _COLORS)
            power = power + _filtered(weights, partial, 3 * room + place, _COLORS)
            structure_max = power - squares + _C2
            inverse = 1.0 / (luminance_max * structure_max)
            value = luminance * structure * inverse
            store(similarity, place, value)
            # Covariances are means of products minus products of means, so a mean changes both.
            by_mean = mean_y * (structure - luminance) * inverse
            by_mean = 2.0 * fma(mean_x * value, 1.0 / structure_max - 1.0 / luminance_max, by_mean)
            store(derivatives, row * stride + place, by_mean)
            store(derivatives, (windows_high + row) * stride + place, 0.0 - value / structure_max)
            store(derivatives, (2 * windows_high + row) * stride + place, 2.0 * luminance * inverse)
        dissimilarity = 0.0
        for place in range(windows_wide):
            dissimilarity += 1.0 - similarity[place]
        sums[row, 1] = dissimilarity


@inlined
def _sign(difference: Any) -> Any:
    """1, 0 or -1; NaN stays NaN."""
    return select(difference > 0.0, 1.0, select(difference < 0.0, -1.0, difference))


@compiled
def _compare_backward(
    begin: int,
    end: int,
    weights: Any,
    image: Any,
    base: Any,
    target: Any,
    derivatives: Any,
    slopes: Any,
    with_base: bool,
    grad_image: Any,
    grad_base: Any,
) -> None:
    """Write the gradients of both images. A pixel is in the windows that begin up to a reach above and left of it."""
    height, length = image.shape[0], _COLORS * image.shape[1]
    windows_high, windows_wide, stride = height - SSIM_WINDOW + 1, length - _REACH, derivatives.shape[2]
    # Zeros on both sides, where no window begins.
    room = _REACH + _whole_lanes(length) + WIDTH
    partial = np.zeros(3 * room, np.float32)
    l1_slope, ssim_slope, base_slope = broadcast(slopes, 0), broadcast(slopes, 1), broadcast(slopes, 2)
    for row in range(begin, end):
        first, last = max(row - SSIM_WINDOW + 1, 0), min(row, windows_high - 1)
        for kind in range(3):
            for place in range(0, windows_wide, WIDTH):
                total = zeros(weights)
                for above in range(first, last + 1):
                    values = load(derivatives, (kind * windows_high + above) * stride + place)
                    total = fma(broadcast(weights, row - above), values, total)
                store(partial, kind * room + _REACH + place, total)
            partial[kind * room + _REACH + windows_wide : (kind + 1) * room] = 0
        for block in range(0, length, WIDTH):
            place = min(block, length - WIDTH)
            # The window is symmetric.
            by_mean = _filtered(weights, partial, place, _COLORS)
            by_square = _filtered(weights, partial, room + place, _COLORS)
            by_product = _filtered(weights, partial, 2 * room + place, _COLORS)
            at = row * length + place
            a, b = load(image, at), load(target, at)
            filtered = fma(2.0 * a, by_square, fma(b, by_product, by_mean))
            store(grad_image, at, fma(ssim_slope, filtered, l1_slope * _sign(a - b)))
            if with_base:
                store(grad_base, at, base_slope * _sign(load(base, at) - b))
