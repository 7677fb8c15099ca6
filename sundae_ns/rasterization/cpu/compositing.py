"""Front-to-back blending of tile lists, and its derivatives back to front; the mathematics stands in
:mod:`sundae_ns.rasterization.compositing`.

A loop over the pixels of a tile does for one primitive what a row of SIMD lanes can do at once, without a branch. The way
back starts from the transmittance that was left, and divides by (1 - alpha) where the way there multiplied; who was
blended in a pixel, it knows from the number of the last one.
"""

from __future__ import annotations

from math import exp
from typing import Any, cast

import numpy as np
import torch
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.rasterization.compositing import MAX_ALPHA, MIN_TRANSMITTANCE
from sundae_ns.rasterization.cpu.parallel import as_array, compiled, compiled_for_simd, share
from sundae_ns.rasterization.cpu.tiles import HALF_XX, HALF_YY, OPACITY, XY, Lists, U, V
from sundae_ns.rasterization.tiles import MIN_ALPHA, TILE

_PIXELS = TILE * TILE
_LOOK = 8  # list entries between two looks at whether a tile is opaque
_FAINTEST = 20.0  # exponents end here, far beyond log(255)
_WORTH_A_THREAD = 8  # tiles
_ABREAST = 4  # channels that a loop over pixels takes together
_MOMENTS = 6  # of a primitive in a tile, behind its channels
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
        packed = np.zeros((len(lists.ids), -(-colors.shape[1] // _ABREAST) * _ABREAST), lists.table.dtype)
        packed[:, : colors.shape[1]] = as_array(colors)[lists.ids]
        left = np.empty((tiles, _PIXELS), lists.table.dtype)
        last = np.empty((tiles, _PIXELS), np.int32)
        share(
            _blend,
            len(lists.busiest),
            lists.busiest,
            lists.starts,
            lists.ranks,
            lists.table,
            packed,
            lists.columns,
            as_array(image),
            as_array(alpha),
            left,
            last,
            at_least=_WORTH_A_THREAD,
        )
        ctx.save_for_backward(means2d, conics, opacities, colors)
        ctx.packed = packed
        ctx.lists, ctx.left, ctx.last, ctx.absgrad = lists, left, last, absgrad
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor) -> tuple[Tensor | None, ...]:
        means2d, conics, opacities, colors = ctx.saved_tensors
        lists: Lists = ctx.lists
        want_geometry, want_colors = any(ctx.needs_input_grad[:3]), ctx.needs_input_grad[3]
        absgrad = ctx.absgrad and want_geometry
        # A tile that became opaque leaves the slots of its later entries alone.
        parts = np.zeros((len(lists.slots), ctx.packed.shape[1] + _MOMENTS + 2 * absgrad), lists.table.dtype)
        share(
            _blend_backward,
            len(lists.busiest),
            lists.busiest,
            lists.starts,
            lists.ranks,
            lists.slots,
            lists.table,
            ctx.packed,
            lists.columns,
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


@cast(Any, intrinsic)
def _fused(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once: so that the way back computes the very alphas of the way there."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, a, a), generate


@cast(Any, intrinsic)
def _power_of_two(typing: Any, exponent: Any) -> Any:
    """2 to the power of an int32, float32: its bits are the exponent, shifted."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(32)
        bits = builder.shl(builder.add(arguments[0], word(127)), word(23))
        return builder.bitcast(bits, ir.FloatType())

    return types.float32(types.int32), generate


def _exp(x: Any) -> Any:
    """exp(x) for x in [-20, 0]: in float32 without a call, so that it runs in SIMD lanes, within one unit in the last place."""
    raise NotImplementedError


@overload(_exp)
def _exp_by_type(x: Any) -> Any:
    def double(x: Any) -> Any:
        return exp(x)

    def single(x: Any) -> Any:
        number = np.float32
        whole = _fused(x, number(1.4426950408889634), number(12582912.0)) - number(12582912.0)  # rounds x / log(2)
        # log(2) in two parts, of which the first has so few bits that its product is exact.
        rest = _fused(whole, number(-0.693359375), x)
        rest = _fused(whole, number(2.12194440e-4), rest)
        # Taylor's series; |rest| is at most log(2) / 2.
        value = number(1 / 5040)
        value = _fused(value, rest, number(1 / 720))
        value = _fused(value, rest, number(1 / 120))
        value = _fused(value, rest, number(1 / 24))
        value = _fused(value, rest, number(1 / 6))
        value = _fused(value, rest, number(0.5))
        value = _fused(value, rest, number(1.0))
        value = _fused(value, rest, number(1.0))
        return value * _power_of_two(np.int32(whole))

    return single if x == types.float32 else double


@compiled
def _uncapped_alpha(dx: Any, dy: Any, half_xx: Any, xy: Any, half_yy: Any, opacity: Any, faintest: Any) -> Any:
    exponent = _fused(_fused(half_xx, dx, xy * dy), dx, half_yy * dy * dy)
    return opacity * _exp(-min(exponent, faintest))


@compiled_for_simd
def _blend(
    begin: int,
    end: int,
    tiles: Any,
    starts: Any,
    ranks: Any,
    table: Any,
    colors: Any,
    columns: int,
    image: Any,
    alpha_image: Any,
    left_over: Any,
    last: Any,
) -> None:
    number = table.dtype.type
    zero, one, faintest = number(0), number(1), number(_FAINTEST)
    least, most, enough = number(MIN_ALPHA), number(MAX_ALPHA), number(MIN_TRANSMITTANCE)
    height, width, channels = image.shape
    across, down = np.empty(_PIXELS, table.dtype), np.empty(_PIXELS, table.dtype)
    for p in range(_PIXELS):
        across[p], down[p] = number(p % TILE + 0.5), number(p // TILE + 0.5)
    through, weights = np.empty(_PIXELS, table.dtype), np.empty(_PIXELS, table.dtype)
    summed, blended = np.empty(_PIXELS, table.dtype), np.empty((colors.shape[1], _PIXELS), table.dtype)
    for k in range(begin, end):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        rest, blended_last = left_over[tile], last[tile]
        for p in range(_PIXELS):
            inside = left + p % TILE < width and top + p // TILE < height
            through[p] = one if inside else zero
            rest[p], blended_last[p], summed[p] = one, 0, zero
        blended[:] = zero
        start = starts[tile]
        for entry in range(start, starts[tile + 1]):
            rank = ranks[entry]
            u, v = table[rank, U] - number(left), table[rank, V] - number(top)
            half_xx, xy, half_yy = table[rank, HALF_XX], table[rank, XY], table[rank, HALF_YY]
            opacity = table[rank, OPACITY]
            place = np.int32(entry - start + 1)
            total = zero
            for p in range(_PIXELS):
                alpha = _uncapped_alpha(across[p] - u, down[p] - v, half_xx, xy, half_yy, opacity, faintest)
                alpha = min(alpha, most)
                before = through[p]
                behind = before * (one - alpha)
                counts = alpha >= least
                goes_on = behind > enough
                taken = counts and goes_on
                weight = alpha * before if taken else zero
                # A pixel that has ended is left no light at all.
                through[p] = (behind if goes_on else zero) if counts else before
                rest[p] = behind if taken else rest[p]
                blended_last[p] = place if taken else blended_last[p]
                weights[p] = weight
                summed[p] += weight
                total += weight
            if total > zero:
                for c in range(0, len(blended), _ABREAST):
                    c0, c1, c2, c3 = colors[rank, c], colors[rank, c + 1], colors[rank, c + 2], colors[rank, c + 3]
                    for p in range(_PIXELS):
                        weight = weights[p]
                        blended[c, p] += c0 * weight
                        blended[c + 1, p] += c1 * weight
                        blended[c + 2, p] += c2 * weight
                        blended[c + 3, p] += c3 * weight
            if place % _LOOK == 0:
                light = zero
                for p in range(_PIXELS):
                    light += through[p]
                if light == zero:
                    break
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                for c in range(channels):
                    image[top + y, left + x, c] = blended[c, y * TILE + x]
                alpha_image[top + y, left + x, 0] = summed[y * TILE + x]


@compiled_for_simd
def _blend_backward(
    begin: int,
    end: int,
    tiles: Any,
    starts: Any,
    ranks: Any,
    slots: Any,
    table: Any,
    colors: Any,
    columns: int,
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
    zero, one, faintest = number(0), number(1), number(_FAINTEST)
    least, most = number(MIN_ALPHA), number(MAX_ALPHA)
    height, width, channels = grad_image.shape
    across, down = np.empty(_PIXELS, table.dtype), np.empty(_PIXELS, table.dtype)
    for p in range(_PIXELS):
        across[p], down[p] = number(p % TILE + 0.5), number(p // TILE + 0.5)
    through, weights = np.empty(_PIXELS, table.dtype), np.empty(_PIXELS, table.dtype)
    behind, pulls = np.empty(_PIXELS, table.dtype), np.empty(_PIXELS, table.dtype)
    grads, alpha_grads = np.zeros((colors.shape[1], _PIXELS), table.dtype), np.zeros(_PIXELS, table.dtype)
    for k in range(begin, end):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        blended_last = last[tile]
        deepest = 0
        for p in range(_PIXELS):
            through[p], behind[p] = left_over[tile, p], zero
            deepest = max(deepest, blended_last[p])
        # Pixels outside of the image keep what the tile before left there: nothing was blended in them.
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                for c in range(channels):
                    grads[c, y * TILE + x] = grad_image[top + y, left + x, c]
                alpha_grads[y * TILE + x] = grad_alpha[top + y, left + x, 0]
        for place in range(deepest, 0, -1):
            entry = starts[tile] + place - 1
            rank, slot = ranks[entry], slots[entry]
            u, v = table[rank, U] - number(left), table[rank, V] - number(top)
            half_xx, xy, half_yy = table[rank, HALF_XX], table[rank, XY], table[rank, HALF_YY]
            opacity = table[rank, OPACITY]
            number_here = np.int32(place)
            if want_geometry:
                for p in range(_PIXELS):
                    pulls[p] = alpha_grads[p]
                for c in range(0, len(grads), _ABREAST):
                    c0, c1, c2, c3 = colors[rank, c], colors[rank, c + 1], colors[rank, c + 2], colors[rank, c + 3]
                    for p in range(_PIXELS):  # becomes <g, c>
                        pulls[p] += (
                            c0 * grads[c, p] + c1 * grads[c + 1, p] + c2 * grads[c + 2, p] + c3 * grads[c + 3, p]
                        )
            m = mx = my = mxx = mxy = myy = zero
            total = zero
            for p in range(_PIXELS):
                dx, dy = across[p] - u, down[p] - v
                uncapped = _uncapped_alpha(dx, dy, half_xx, xy, half_yy, opacity, faintest)
                alpha = min(uncapped, most)
                taken = alpha >= least and number_here <= blended_last[p]
                inverse = one / (one - alpha)
                before = through[p] * inverse
                weight = alpha * before if taken else zero
                through[p] = before if taken else through[p]
                weights[p] = weight
                total += weight
                gain = weight * pulls[p]
                pull = gain - alpha * inverse * behind[p]
                behind[p] += gain
                pull = pull if taken and uncapped < most else zero
                pulls[p] = pull
                m += pull
                mx += pull * dx
                my += pull * dy
                mxx += pull * dx * dx
                mxy += pull * dx * dy
                myy += pull * dy * dy
            if not total > zero:
                continue
            if want_colors:
                for c in range(0, len(grads), _ABREAST):
                    g0 = g1 = g2 = g3 = zero
                    for p in range(_PIXELS):
                        weight = weights[p]
                        g0 += weight * grads[c, p]
                        g1 += weight * grads[c + 1, p]
                        g2 += weight * grads[c + 2, p]
                        g3 += weight * grads[c + 3, p]
                    parts[slot, c], parts[slot, c + 1], parts[slot, c + 2], parts[slot, c + 3] = g0, g1, g2, g3
            if want_geometry:
                moments = parts[slot, len(grads) :]
                moments[0], moments[1], moments[2] = m, mx, my
                moments[3], moments[4], moments[5] = mxx, mxy, myy
            if absgrad:
                xx, yy = number(2) * half_xx, number(2) * half_yy
                absolute_x = absolute_y = zero
                for p in range(_PIXELS):
                    dx, dy = across[p] - u, down[p] - v
                    absolute_x += abs(pulls[p] * (xx * dx + xy * dy))
                    absolute_y += abs(pulls[p] * (xy * dx + yy * dy))
                parts[slot, len(grads) + _MOMENTS] = absolute_x
                parts[slot, len(grads) + _MOMENTS + 1] = absolute_y


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
    channels, width = parts.shape[1] - _MOMENTS - (2 if len(absolute) > 0 else 0), parts.shape[1]
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
            absolute[0, i, 0] = sums[channels + _MOMENTS]
            absolute[0, i, 1] = sums[channels + _MOMENTS + 1]
