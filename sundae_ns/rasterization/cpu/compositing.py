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
    totals,
    zeros,
)
from sundae_ns.rasterization.cpu.parallel import as_array, compiled, share
from sundae_ns.rasterization.cpu.tiles import HALF_XX, HALF_YY, OPACITY, XY, Lists, U, V
from sundae_ns.rasterization.tiles import MIN_ALPHA, TILE

_PIXELS = TILE * TILE
_LOOK = 8  # list entries between two looks at whether a tile is opaque
_FAINTEST = 20.0  # exponents end here, far beyond log(255)
_WORTH_A_THREAD = 8  # tiles
_MOMENTS = WIDTH  # of a primitive in a tile, behind its channels: six, and two absolute gradients
_WORTH_A_THREAD_TO_SUM = 20_000  # primitives


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
        image = colors.new_zeros(height, width, colors.shape[1])
        alpha = colors.new_zeros(height, width, 1)
        tiles = lists.columns * lists.rows
        left = np.empty((tiles, _PIXELS), lists.table.dtype)
        last = np.empty((tiles, _PIXELS), np.int32)
        share(
            _blend,
            len(lists.busiest),
            *lists.for_blending(),
            as_array(colors),
            as_array(image),
            as_array(alpha),
            left,
            last,
            at_least=_WORTH_A_THREAD,
        )
        ctx.save_for_backward(means2d, conics, opacities, colors)
        ctx.lists, ctx.left, ctx.last, ctx.absgrad = lists, left, last, absgrad
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor) -> tuple[Tensor | None, ...]:
        means2d, conics, opacities, colors = ctx.saved_tensors
        lists: Lists = ctx.lists
        want_geometry, want_colors = any(ctx.needs_input_grad[:3]), ctx.needs_input_grad[3]
        absgrad = ctx.absgrad and want_geometry
        padded = -(-colors.shape[1] // WIDTH) * WIDTH
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
        outputs = [torch.zeros_like(value, memory_format=torch.contiguous_format) for value in ctx.saved_tensors]
        absolute = torch.zeros_like(outputs[0]) if absgrad else outputs[0].new_zeros(0, 0, 0)
        share(
            _sum_slots,
            len(lists.ids),
            lists.ids,
            lists.first_slots,
            lists.table,
            parts,
            *(as_array(value) for value in (*outputs, absolute)),
            at_least=_WORTH_A_THREAD_TO_SUM,
        )
        if ctx.absgrad:
            means2d.absgrad = absolute if absgrad else torch.zeros_like(outputs[0])
        geometry = outputs[:3] if want_geometry else (None, None, None)
        return *geometry, outputs[3] if want_colors else None, None, None, None, None


@compiled
def _uncapped_alphas(across: Any, dy: Any, half_xx: Any, xy: Any, half_yy: Any, opacity: Any) -> Any:
    exponents = fused(fused(half_xx, across, xy * dy), across, half_yy * dy * dy)
    return decay(least(exponents, _FAINTEST)) * opacity


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
    centres = np.arange(TILE).astype(table.dtype) + number(0.5)
    places = load(centres, 0)
    summed, blended = np.empty(_PIXELS, table.dtype), np.empty((TILE, channels, TILE), table.dtype)
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
            across = places - (table[rank, U] - number(left))
            v = table[rank, V] - number(top)
            half_xx, xy, half_yy = table[rank, HALF_XX], table[rank, XY], table[rank, HALF_YY]
            opacity = table[rank, OPACITY]
            place = entry - start + 1
            for y in range(spans[entry, 0], spans[entry, 1]):
                row = y * TILE
                alphas = least(_uncapped_alphas(across, centres[y] - v, half_xx, xy, half_yy, opacity), MAX_ALPHA)
                counts = alphas >= MIN_ALPHA
                if not anywhere(counts):
                    continue
                before = load(through, row)
                behind = before * (1.0 - alphas)
                taken = both(counts, behind > MIN_TRANSMITTANCE)
                ended = choose(counts, 0.0 - magnitude(before), before)
                store(through, row, choose(taken, behind, ended))
                if not anywhere(taken):
                    continue
                weights = choose(taken, alphas * before, 0.0)
                store(blended_last, row, choose(taken, place, load(blended_last, row)))
                store(summed, row, load(summed, row) + weights)
                for c in range(channels):
                    at = row * channels + c * TILE
                    store(blended, at, fused(weights, spread(colors, color + c), load(blended, at)))
            if place % _LOOK == 0 and not _light(through):
                break
        for p in range(_PIXELS):
            through[p] = abs(through[p])
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                for c in range(channels):
                    image[top + y, left + x, c] = blended[y, c, x]
                alpha_image[top + y, left + x, 0] = summed[y * TILE + x]


@compiled
def _light(through: Any) -> bool:
    """Whether any pixel of a tile has not ended."""
    light = False
    for p in range(0, _PIXELS, TILE):
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
    centres = np.arange(TILE).astype(table.dtype) + number(0.5)
    places, none = load(centres, 0), zeros(table)
    through, behind = np.empty(_PIXELS, table.dtype), np.empty(_PIXELS, table.dtype)
    weights, grads = np.empty(_PIXELS, table.dtype), np.zeros((TILE, padded, TILE), table.dtype)
    alpha_grads = np.zeros(_PIXELS, table.dtype)
    for k in range(begin, end):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        through[:] = left_over[tile]
        behind[:] = 0
        blended_last = last[tile]
        # Pixels outside of the image keep what the tile before left there: nothing was blended in them.
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                for c in range(channels):
                    grads[y, c, x] = grad_image[top + y, left + x, c]
                alpha_grads[y * TILE + x] = grad_alpha[top + y, left + x, 0]
        deepest = blended_last.max()
        start = starts[tile]
        for entry in range(start + deepest, starts[tile + 1]):
            parts[slots[entry]] = 0
        for place in range(deepest, 0, -1):
            entry = start + place - 1
            rank = ranks[entry]
            color = channels * ids[rank]
            across = places - (table[rank, U] - number(left))
            v = table[rank, V] - number(top)
            half_xx, xy, half_yy = table[rank, HALF_XX], table[rank, XY], table[rank, HALF_YY]
            opacity = table[rank, OPACITY]
            first, beyond = spans[entry, 0], spans[entry, 1]
            m = mx = my = mxx = mxy = myy = absolute_x = absolute_y = none
            for y in range(first, beyond):
                row, dy = y * TILE, centres[y] - v
                uncapped = _uncapped_alphas(across, dy, half_xx, xy, half_yy, opacity)
                alphas = least(uncapped, MAX_ALPHA)
                taken = both(alphas >= MIN_ALPHA, load(blended_last, row) >= place)
                inverse = 1.0 / (1.0 - alphas)
                before = load(through, row) * inverse
                weight = choose(taken, alphas * before, 0.0)
                store(weights, row, weight)
                if not anywhere(taken):
                    continue
                store(through, row, choose(taken, before, load(through, row)))
                if want_geometry:
                    pull = load(alpha_grads, row)  # becomes <g, c>
                    for c in range(channels):
                        pull = fused(load(grads, row * padded + c * TILE), spread(colors, color + c), pull)
                    gain = weight * pull
                    light = load(behind, row)
                    store(behind, row, light + gain)
                    pull = choose(both(taken, uncapped < MAX_ALPHA), gain - alphas * inverse * light, 0.0)
                    pull_x = pull * across
                    m, mx, mxx = m + pull, mx + pull_x, fused(pull_x, across, mxx)
                    my, myy, mxy = fused(pull, dy, my), fused(pull, dy * dy, myy), fused(pull_x, dy, mxy)
                    if absgrad:
                        slope_x = fused(across, number(2) * half_xx, xy * dy)
                        slope_y = fused(across, xy, number(2) * half_yy * dy)
                        absolute_x = absolute_x + magnitude(pull * slope_x)
                        absolute_y = absolute_y + magnitude(pull * slope_y)
            part = slots[entry] * parts.shape[1]
            if want_colors:
                for c in range(0, padded, TILE):
                    store(parts, part + c, _weighed(weights, grads, first, beyond, c))
            store(parts, part + padded, totals(m, mx, my, mxx, mxy, myy, absolute_x, absolute_y))


@compiled
def _weighed(weights: Any, grads: Any, first: int, beyond: int, c: int) -> Any:
    """Sums over some rows of pixels, of the weights times the gradients of eight channels."""
    a = b = d = e = f = g = h = i = zeros(weights)
    for y in range(first, beyond):
        weight = load(weights, y * TILE)
        at = (y * grads.shape[1] + c) * TILE
        a, b = fused(weight, load(grads, at), a), fused(weight, load(grads, at + TILE), b)
        d, e = fused(weight, load(grads, at + 2 * TILE), d), fused(weight, load(grads, at + 3 * TILE), e)
        f, g = fused(weight, load(grads, at + 4 * TILE), f), fused(weight, load(grads, at + 5 * TILE), g)
        h, i = fused(weight, load(grads, at + 6 * TILE), h), fused(weight, load(grads, at + 7 * TILE), i)
    return totals(a, b, d, e, f, g, h, i)


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
