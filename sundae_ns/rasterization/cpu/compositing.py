"""Front-to-back blending of tile lists, and its derivatives back to front; the mathematics stands in
:mod:`sundae_ns.rasterization.compositing`.

A loop over the pixels of a tile does for one primitive what a row of SIMD lanes can do at once, without a branch. The way
back starts from the transmittance that was left, and divides by (1 - alpha) where the way there multiplied; who was
blended in a pixel, it knows from the number of the last one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.rasterization.compositing import MAX_ALPHA, MIN_TRANSMITTANCE
from sundae_ns.rasterization.cpu.lanes import (
    WIDTH,
    anywhere,
    both,
    choose,
    decay,
    fused,
    least,
    load,
    magnitude,
    spread,
    store,
    store_totals,
    zeros,
)
from sundae_ns.rasterization.cpu.parallel import as_array, compiled, compiled_into, share
from sundae_ns.rasterization.cpu.tiles import HALF_XX, HALF_YY, OPACITY, XY, Lists, U, V
from sundae_ns.rasterization.tiles import MIN_ALPHA, TILE

_PIXELS = TILE * TILE
_LOOK = 8  # list entries between two looks at whether a tile is opaque
_FAINTEST = 20.0  # exponents end here, far beyond log(255)
_WORTH_A_THREAD = 8  # tiles
_ABREAST = 8  # channels whose gradients are summed together
_MOMENTS = 8  # of a primitive in a tile, behind its channels: six, and two absolute gradients
_WORTH_A_THREAD_TO_SUM = 5_000  # primitives


def composite(
    means2d: Tensor,  # [1, N, 2]
    conics: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, C]
    lists: Lists,
    width: int,
    height: int,
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """As :func:`sundae_ns.rasterization.compositing.composite`; the lists hold centres, conics and opacities too."""
    return _Composite.apply(means2d, conics, opacities, colors, lists, width, height, absgrad)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        colors: Tensor,
        lists: Lists,
        width: int,
        height: int,
        absgrad: bool,
    ) -> tuple[Tensor, Tensor]:
        image = np.zeros((height, width, colors.shape[1]), lists.table.dtype)
        alpha = np.zeros((height, width, 1), lists.table.dtype)
        tiles = lists.columns * lists.rows
        left = np.empty((tiles, _PIXELS), lists.table.dtype)
        last = np.empty((tiles, _PIXELS), np.int32)
        share(
            _blend,
            len(lists.busiest),
            *lists.for_blending(),
            as_array(colors),
            image,
            alpha,
            left,
            last,
            at_least=_WORTH_A_THREAD,
        )
        ctx.save_for_backward(means2d, conics, opacities, colors)
        ctx.lists, ctx.left, ctx.last, ctx.absgrad = lists, left, last, absgrad
        return torch.from_numpy(image), torch.from_numpy(alpha)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor) -> tuple[Tensor | None, ...]:
        means2d, conics, opacities, colors = ctx.saved_tensors
        lists: Lists = ctx.lists
        want_geometry, want_colors = any(ctx.needs_input_grad[:3]), ctx.needs_input_grad[3]
        absgrad = ctx.absgrad and want_geometry
        padded = -(-colors.shape[1] // _ABREAST) * _ABREAST
        parts = np.empty((len(lists.slots), padded + _MOMENTS), lists.table.dtype)
        share(
            _blend_backward,
            len(lists.busiest),
            *lists.for_blending(),
            as_array(colors),
            lists.slots,
            ctx.left,
            ctx.last,
            as_array(grad_image),
            as_array(grad_alpha),
            want_geometry,
            want_colors,
            absgrad,
            parts,
            at_least=_WORTH_A_THREAD,
        )
        outputs = [np.zeros(value.shape, lists.table.dtype) for value in ctx.saved_tensors]
        absolute = np.zeros(means2d.shape if absgrad else (0, 0, 0), lists.table.dtype)
        share(
            _sum_slots,
            len(lists.ids),
            lists.ids,
            lists.first_slots,
            lists.table,
            parts,
            *outputs,
            absolute,
            at_least=_WORTH_A_THREAD_TO_SUM,
        )
        if ctx.absgrad:
            means2d.absgrad = torch.from_numpy(absolute) if absgrad else torch.zeros_like(means2d)
        wanted = (want_geometry, want_geometry, want_geometry, want_colors)
        grads = (torch.from_numpy(output) if want else None for output, want in zip(outputs, wanted))
        return *grads, None, None, None, None


@compiled_into
def _uncapped_alphas(dx: Any, dy: Any, half_xx: Any, xy: Any, half_yy: Any, opacity: Any) -> Any:
    exponents = fused(fused(dx, half_xx, dy * xy), dx, dy * dy * half_yy)
    return decay(least(exponents, _FAINTEST)) * opacity


@compiled
def _pixel_centres(like: Any) -> Any:
    """Coordinates of the pixels of a tile: x ``[P]`` and y ``[P]``."""
    across, down = np.empty(_PIXELS, like.dtype), np.empty(_PIXELS, like.dtype)
    for p in range(_PIXELS):
        across[p], down[p] = p % TILE + 0.5, p // TILE + 0.5
    return across, down


@compiled
def _blend(
    begin: int,
    end: int,
    columns: int,
    tiles: Any,
    starts: Any,
    ranks: Any,
    spans: Any,
    ids: Any,
    table: Any,
    colors: Any,
    image: Any,
    alpha_image: Any,
    left_over: Any,
    last: Any,
) -> None:
    number = table.dtype.type
    height, width, channels = image.shape
    across, down = _pixel_centres(table)
    x = load(across, 0)
    # Channels of as many pixels as there are lanes stand together.
    summed, blended = np.empty(_PIXELS, table.dtype), np.empty((_PIXELS // WIDTH, channels, WIDTH), table.dtype)
    for k in range(begin, end):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        # Light that comes through a pixel; negative once it has ended, and outside of the image.
        through, blended_last = left_over[tile], last[tile]
        for p in range(_PIXELS):
            inside = left + p % TILE < width and top + p // TILE < height
            through[p] = number(1) if inside else number(-1)
        blended_last[:] = 0
        summed[:] = 0
        blended[:] = 0
        start = starts[tile]
        for entry in range(start, starts[tile + 1]):
            rank = ranks[entry]
            color = channels * ids[rank]
            dx, v = x - (table[rank, U] - number(left)), table[rank, V] - number(top)
            half_xx, xy, half_yy = table[rank, HALF_XX], table[rank, XY], table[rank, HALF_YY]
            opacity = table[rank, OPACITY]
            place = entry - start + 1
            for step in range(spans[entry, 0], spans[entry, 1]):
                p = step * WIDTH
                alphas = least(_uncapped_alphas(dx, load(down, p) - v, half_xx, xy, half_yy, opacity), MAX_ALPHA)
                before = load(through, p)
                behind = before * (1.0 - alphas)
                counts = alphas >= MIN_ALPHA
                taken = both(counts, behind > MIN_TRANSMITTANCE)
                store(through, p, choose(taken, behind, choose(counts, 0.0 - magnitude(before), before)))
                if not anywhere(taken):
                    continue
                weights = choose(taken, alphas * before, 0.0)
                store(blended_last, p, choose(taken, place, load(blended_last, p)))
                store(summed, p, load(summed, p) + weights)
                for c in range(channels):
                    at = p * channels + c * WIDTH
                    store(blended, at, fused(weights, spread(colors, color + c), load(blended, at)))
            if place % _LOOK == 0 and not _light(through):
                break
        for p in range(_PIXELS):
            through[p] = abs(through[p])
        for y in range(min(TILE, height - top)):
            for x_of_pixel in range(min(TILE, width - left)):
                p = y * TILE + x_of_pixel
                for c in range(channels):
                    image[top + y, left + x_of_pixel, c] = blended[p // WIDTH, c, p % WIDTH]
                alpha_image[top + y, left + x_of_pixel, 0] = summed[p]


@compiled_into
def _light(through: Any) -> bool:
    """Whether any pixel of a tile has not ended."""
    light = False
    for p in range(0, _PIXELS, WIDTH):
        light = light or anywhere(load(through, p) > 0.0)
    return light


@compiled
def _blend_backward(
    begin: int,
    end: int,
    columns: int,
    tiles: Any,
    starts: Any,
    ranks: Any,
    spans: Any,
    ids: Any,
    table: Any,
    colors: Any,
    slots: Any,
    left_over: Any,
    last: Any,
    grad_image: Any,
    grad_alpha: Any,
    want_geometry: bool,
    want_colors: bool,
    absgrad: bool,
    parts: Any,
) -> None:
    """Write, for every slot, the gradient of the channels, the moments of dL/de, and the absolute gradient of the centre."""
    number = table.dtype.type
    height, width, channels = grad_image.shape
    padded = parts.shape[1] - _MOMENTS
    across, down = _pixel_centres(table)
    x, none = load(across, 0), zeros(table)
    through, behind = np.empty(_PIXELS, table.dtype), np.empty(_PIXELS, table.dtype)
    weights, grads = np.empty(_PIXELS, table.dtype), np.zeros((_PIXELS // WIDTH, padded, WIDTH), table.dtype)
    alpha_grads = np.zeros(_PIXELS, table.dtype)
    for k in range(begin, end):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        through[:] = left_over[tile]
        behind[:] = 0
        blended_last = last[tile]
        # Pixels outside of the image keep what the tile before left there: nothing was blended in them.
        for y in range(min(TILE, height - top)):
            for x_of_pixel in range(min(TILE, width - left)):
                p = y * TILE + x_of_pixel
                for c in range(channels):
                    grads[p // WIDTH, c, p % WIDTH] = grad_image[top + y, left + x_of_pixel, c]
                alpha_grads[p] = grad_alpha[top + y, left + x_of_pixel, 0]
        start, deepest = starts[tile], blended_last.max()
        for entry in range(start + deepest, starts[tile + 1]):
            parts[slots[entry]] = 0
        for place in range(deepest, 0, -1):
            entry = start + place - 1
            rank = ranks[entry]
            color = channels * ids[rank]
            dx, v = x - (table[rank, U] - number(left)), table[rank, V] - number(top)
            half_xx, xy, half_yy = table[rank, HALF_XX], table[rank, XY], table[rank, HALF_YY]
            opacity = table[rank, OPACITY]
            m = mx = my = mxx = mxy = myy = absolute_x = absolute_y = none
            for step in range(spans[entry, 0], spans[entry, 1]):
                p = step * WIDTH
                dy = load(down, p) - v
                uncapped = _uncapped_alphas(dx, dy, half_xx, xy, half_yy, opacity)
                alphas = least(uncapped, MAX_ALPHA)
                taken = both(alphas >= MIN_ALPHA, load(blended_last, p) >= place)
                inverse = 1.0 / (1.0 - alphas)
                before = load(through, p) * inverse
                weight = choose(taken, alphas * before, 0.0)
                store(weights, p, weight)
                if not anywhere(taken):
                    continue
                store(through, p, choose(taken, before, load(through, p)))
                if want_geometry:
                    gain = weight * (load(alpha_grads, p) + _product(grads, p * padded, colors, color, channels))
                    light = load(behind, p)
                    store(behind, p, light + gain)
                    pull = choose(both(taken, uncapped < MAX_ALPHA), gain - alphas * inverse * light, 0.0)
                    pull_x, pull_y = pull * dx, pull * dy
                    m, mx, my = m + pull, mx + pull_x, my + pull_y
                    mxx, mxy, myy = fused(pull_x, dx, mxx), fused(pull_x, dy, mxy), fused(pull_y, dy, myy)
                    if absgrad:
                        slope_x = fused(dx, number(2) * half_xx, dy * xy)
                        slope_y = fused(dx, xy, dy * (number(2) * half_yy))
                        absolute_x = absolute_x + magnitude(pull * slope_x)
                        absolute_y = absolute_y + magnitude(pull * slope_y)
            part = slots[entry] * parts.shape[1]
            if want_colors:
                for c in range(0, padded, _ABREAST):
                    _weigh(weights, grads, spans[entry, 0], spans[entry, 1], c, parts, part + c)
            store_totals(parts, part + padded, m, mx, my, mxx, mxy, myy, absolute_x, absolute_y)


@compiled_into
def _product(grads: Any, at: int, colors: Any, color: int, channels: int) -> Any:
    """<g, c> of some pixels; in two sums, since either waits for itself."""
    even = odd = zeros(grads)
    for c in range(0, channels, 2):
        even = fused(load(grads, at + c * WIDTH), spread(colors, color + c), even)
        if c + 1 < channels:
            odd = fused(load(grads, at + c * WIDTH + WIDTH), spread(colors, color + c + 1), odd)
    return even + odd


@compiled_into
def _weigh(weights: Any, grads: Any, first: int, beyond: int, channel: int, parts: Any, part: int) -> None:
    """Write the sums over some pixels of a tile, of the weights times the gradients of eight channels."""
    a = b = c = d = e = f = g = h = zeros(weights)
    for step in range(first, beyond):
        weight = load(weights, step * WIDTH)
        at = (step * grads.shape[1] + channel) * WIDTH
        a, b = fused(weight, load(grads, at), a), fused(weight, load(grads, at + WIDTH), b)
        c, d = fused(weight, load(grads, at + 2 * WIDTH), c), fused(weight, load(grads, at + 3 * WIDTH), d)
        e, f = fused(weight, load(grads, at + 4 * WIDTH), e), fused(weight, load(grads, at + 5 * WIDTH), f)
        g, h = fused(weight, load(grads, at + 6 * WIDTH), g), fused(weight, load(grads, at + 7 * WIDTH), h)
    store_totals(parts, part, a, b, c, d, e, f, g, h)


@compiled
def _sum_slots(
    begin: int,
    end: int,
    ids: Any,
    first_slots: Any,
    table: Any,
    parts: Any,
    grad_means2d: Any,
    grad_conics: Any,
    grad_opacities: Any,
    grad_colors: Any,
    absolute: Any,
) -> None:
    """Add up the slots of each primitive, in float64, and turn moments into gradients."""
    channels, width = parts.shape[1] - _MOMENTS, parts.shape[1]
    sums = np.empty(width)
    for rank in range(begin, end):
        i = ids[rank]
        sums[:] = 0
        for slot in range(first_slots[rank], first_slots[rank + 1]):
            for d in range(width):
                sums[d] += parts[slot, d]
        for c in range(grad_colors.shape[1]):
            grad_colors[i, c] = sums[c]
        xx, xy, yy = 2 * float(table[rank, HALF_XX]), table[rank, XY], 2 * float(table[rank, HALF_YY])
        mx, my = sums[channels + 1], sums[channels + 2]
        grad_means2d[0, i, 0], grad_means2d[0, i, 1] = xx * mx + xy * my, xy * mx + yy * my
        grad_conics[i, 0] = -0.5 * sums[channels + 3]
        grad_conics[i, 1] = -sums[channels + 4]
        grad_conics[i, 2] = -0.5 * sums[channels + 5]
        grad_opacities[i] = sums[channels] / table[rank, OPACITY]
        if len(absolute) > 0:
            absolute[0, i, 0] = sums[channels + 6]
            absolute[0, i, 1] = sums[channels + 7]
