"""Front-to-back blending of tile lists, and its derivatives back to front.

For pixel p and list entry m, with g the gradient of the loss with respect to the blended channels:

- alpha_m = min(0.999, opacity exp(-e_m)), where e_m is half the squared Mahalanobis distance to the centre;
- T_m = prod over k < m of (1 - alpha_k), w_m = alpha_m T_m, and the image is sum_m w_m c_m;
- -dL/de_m = w_m <g, c_m> - alpha_m / (1 - alpha_m) * sum over k > m of w_k <g, c_k>, and 0 where alpha is clamped.

A loop over the pixels of a tile handles one Gaussian at a time, many pixels in SIMD lanes. The backward pass starts
from the final transmittance and divides by (1 - alpha) where the forward pass multiplied; the position of the last
blended entry of each pixel tells which entries were blended.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sundae_ns.rasterize.cpu.lanes import (
    WIDTH,
    absolute,
    any_lane,
    exp_negative,
    fma,
    load,
    minimum,
    select,
    store,
    store_sums,
    zeros,
)
from sundae_ns.rasterize.cpu.parallel import as_array, compiled, inlined, parallel_for
from sundae_ns.rasterize.cpu.tiles import HALF_XX, HALF_YY, MIN_PER_THREAD, OPACITY, TILE, XY, Lists, U, V, tile_lists
from sundae_ns.rasterize.reference import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, Projection

_PIXELS = TILE * TILE
_CHECK_EVERY = 8  # list entries between two checks for opaque tiles
_GATHERED = 16  # list entries whose numbers are read together
_COLORS = OPACITY + 1  # first column of the colours among these numbers
_FAINTEST = 20.0  # upper bound of negated exponents, far beyond log(255)
_MIN_TILES = 8  # tiles that are worth another thread
_GROUP = 4  # channels whose gradients are summed together: their sums stay in registers, also in those of AVX2
_MOMENTS = 8  # sums per Gaussian and tile after the channels: six moments, two absolute gradients


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        colors: Tensor,
        size: tuple[int, int],
        lists: Callable[[], Iterable[Lists]],
        absgrad: bool,
    ) -> tuple[Tensor, Tensor]:
        width, height = size
        values = as_array(colors)
        tiles = -(-width // TILE) * -(-height // TILE)
        image, alpha = (np.zeros((height, width, channels), values.dtype) for channels in (values.shape[1], 1))
        ends = np.empty((2, tiles, _PIXELS), values.dtype)
        for before, region in enumerate(lists()):
            arguments = (tuple(region), values, image, alpha, *ends)
            parallel_for(_blend, len(region.longest_first), *arguments, min_per_thread=_MIN_TILES)
            ctx.lists = lists if before else [region].copy  # lists of several regions may exceed the memory
        ctx.save_for_backward(means2d, conics, opacities, colors)
        ctx.ends = ends
        ctx.absgrad = absgrad
        return torch.from_numpy(image), torch.from_numpy(alpha)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor) -> tuple[Tensor | None, ...]:
        means2d, _, _, colors = ctx.saved_tensors
        needs_geometry, needs_colors = any(ctx.needs_input_grad[:3]), ctx.needs_input_grad[3]
        absgrad = ctx.absgrad and needs_geometry
        values = as_array(colors)
        padded = -(-colors.shape[1] // _GROUP) * _GROUP
        gradients = as_array(grad_image), as_array(grad_alpha)
        needs = needs_geometry, needs_colors, absgrad, padded
        outputs = tuple(np.zeros(value.shape, values.dtype) for value in ctx.saved_tensors)
        absolute_grads = np.zeros(means2d.shape if absgrad else (0, 0, 0), values.dtype)
        for region in ctx.lists():
            parts = np.empty((len(region.ranks), padded + _MOMENTS * needs_geometry), values.dtype)
            arguments = (tuple(region), (values, *ctx.ends), gradients, needs, parts)
            parallel_for(_blend_backward, len(region.longest_first), *arguments, min_per_thread=_MIN_TILES)
            # Each thread reads all lists, for its own Gaussians.
            shares = max(1, min(torch.get_num_threads(), len(region.ids) // MIN_PER_THREAD))
            summed = (shares, tuple(region), ctx.ends[1], parts, padded, outputs, absolute_grads)
            parallel_for(_sum_entries, shares, *summed)
        if ctx.absgrad:
            means2d.absgrad = torch.from_numpy(absolute_grads) if absgrad else torch.zeros_like(means2d)
        return *map(torch.from_numpy, outputs), None, None, None


def composite(
    means2d: Tensor, projection: Projection, opacities: Tensor, colors: Tensor, size: tuple[int, int], *, absgrad: bool
) -> tuple[Tensor, Tensor]:
    """As :func:`sundae_ns.rasterize.reference.composite`, once differentiable."""
    splats = means2d, projection.conics, opacities, colors
    lists = partial(tile_lists, projection, opacities, *size)
    return cast("tuple[Tensor, Tensor]", _Composite.apply(*splats, size, lists, absgrad))


@inlined
def _unclamped_alphas(dx: Any, dy: Any, row: Any) -> Any:
    exponents = fma(fma(dx, row[HALF_XX], dy * row[XY]), dx, dy * dy * row[HALF_YY])
    return exp_negative(minimum(exponents, _FAINTEST)) * row[OPACITY]


@compiled
def _blend(
    begin: int, end: int, lists: Any, colors: Any, image: Any, alpha_image: Any, transmittances: Any, last: Any
) -> None:
    columns, tiles, starts, ranks, spans, ids, table = lists
    number = table.dtype.type
    height, width, channels = image.shape
    x = load((np.arange(WIDTH) % TILE + 0.5).astype(table.dtype), 0)
    down = (np.arange(_PIXELS) // TILE + 0.5).astype(table.dtype)
    # Pixels are the fastest axis within a group of WIDTH, then channels.
    summed, blended = np.empty(_PIXELS, table.dtype), np.empty((_PIXELS // WIDTH, channels, WIDTH), table.dtype)
    gathered = np.empty((_GATHERED, _COLORS + channels), table.dtype)
    for k in range(begin, end):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        # Transmittance of each pixel; negative once it is finished, and outside the image.
        through, blended_last = transmittances[tile], last[tile]
        for p in range(_PIXELS):
            inside = left + p % TILE < width and top + p // TILE < height
            through[p] = number(1) if inside else number(-1)
        blended_last[:] = 0
        summed[:] = 0
        blended[:] = 0
        start = starts[tile]
        for entry in range(start, starts[tile + 1]):
            gathered_at = (entry - start) % _GATHERED
            if gathered_at == 0:
                _gather(ranks, entry, starts[tile + 1], table, ids, colors, gathered)
            row = gathered[gathered_at]
            dx, v = x - (row[U] - number(left)), row[V] - number(top)
            nth = entry - start + 1
            for step in range(spans[entry, 0], spans[entry, 1]):
                p = step * WIDTH
                alphas = minimum(_unclamped_alphas(dx, load(down, p) - v, row), MAX_ALPHA)
                before = load(through, p)
                behind = before * (1.0 - alphas)
                visible = alphas >= MIN_ALPHA
                blends = visible & (behind > MIN_TRANSMITTANCE)
                store(through, p, select(blends, behind, select(visible, 0.0 - absolute(before), before)))
                weights = select(blends, alphas * before, 0.0)
                store(blended_last, p, select(blends, nth, load(blended_last, p)))
                store(summed, p, load(summed, p) + weights)
                for c in range(channels):
                    at = p * channels + c * WIDTH
                    store(blended, at, fma(weights, row[_COLORS + c], load(blended, at)))
            if nth % _CHECK_EVERY == 0 and not _any_unfinished(through):
                break
        through[:] = np.abs(through)
        for y in range(min(TILE, height - top)):
            for x_of_pixel in range(min(TILE, width - left)):
                p = y * TILE + x_of_pixel
                for c in range(channels):
                    image[top + y, left + x_of_pixel, c] = blended[p // WIDTH, c, p % WIDTH]
                alpha_image[top + y, left + x_of_pixel, 0] = summed[p]


@inlined
def _gather(ranks: Any, first: int, end: int, table: Any, ids: Any, colors: Any, gathered: Any) -> None:
    """Copy what the next entries of a list blend: the processor waits for all of these rows at once."""
    for k in range(min(end - first, len(gathered))):
        rank = ranks[first + k]
        for column in range(_COLORS):
            gathered[k, column] = table[rank, column]
        for c in range(colors.shape[1]):
            gathered[k, _COLORS + c] = colors[ids[rank], c]


@inlined
def _any_unfinished(through: Any) -> bool:
    unfinished = False
    for p in range(0, _PIXELS, WIDTH):
        unfinished = unfinished or any_lane(load(through, p) > 0.0)
    return unfinished


@compiled
def _blend_backward(begin: int, end: int, lists: Any, blended: Any, gradients: Any, needs: Any, parts: Any) -> None:
    """Write the gradients of channels, the moments of dL/de and the absolute gradient of the centre of each entry."""
    columns, tiles, starts, ranks, spans, ids, table = lists
    colors, transmittances, last = blended
    grad_image, grad_alpha = gradients
    needs_geometry, needs_colors, absgrad, padded = needs
    number = table.dtype.type
    height, width, channels = grad_image.shape
    x, none = load((np.arange(WIDTH) % TILE + 0.5).astype(table.dtype), 0), zeros(table)
    down = (np.arange(_PIXELS) // TILE + 0.5).astype(table.dtype)
    through, behind = np.empty(_PIXELS, table.dtype), np.empty(_PIXELS, table.dtype)
    weights, grads = np.empty(_PIXELS, table.dtype), np.zeros((_PIXELS // WIDTH, padded, WIDTH), table.dtype)
    alpha_grads = np.zeros(_PIXELS, table.dtype)
    gathered = np.empty((_GATHERED, _COLORS + channels), table.dtype)
    for k in range(begin, end):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        through[:] = transmittances[tile]
        behind[:] = 0
        blended_last = last[tile]
        # Pixels outside the image keep stale values of the previous tile: nothing was blended in them.
        for y in range(min(TILE, height - top)):
            for x_of_pixel in range(min(TILE, width - left)):
                p = y * TILE + x_of_pixel
                for c in range(channels):
                    grads[p // WIDTH, c, p % WIDTH] = grad_image[top + y, left + x_of_pixel, c]
                alpha_grads[p] = grad_alpha[top + y, left + x_of_pixel, 0]
        start, deepest = starts[tile], int(blended_last.max())
        for nth in range(deepest, 0, -1):
            entry = start + nth - 1
            gathered_at = (nth - 1) % _GATHERED
            if nth == deepest or gathered_at == _GATHERED - 1:
                _gather(ranks, entry - gathered_at, entry + 1, table, ids, colors, gathered)
            row = gathered[gathered_at]
            dx, v = x - (row[U] - number(left)), row[V] - number(top)
            m = mx = my = mxx = mxy = myy = absolute_x = absolute_y = none
            for step in range(spans[entry, 0], spans[entry, 1]):
                p = step * WIDTH
                dy = load(down, p) - v
                unclamped = _unclamped_alphas(dx, dy, row)
                alphas = minimum(unclamped, MAX_ALPHA)
                blends = (alphas >= MIN_ALPHA) & (load(blended_last, p) >= nth)
                inverse = 1.0 / (1.0 - alphas)
                before = load(through, p) * inverse
                weight = select(blends, alphas * before, 0.0)
                store(weights, p, weight)
                if not any_lane(blends):
                    continue
                store(through, p, select(blends, before, load(through, p)))
                if needs_geometry:
                    gain = weight * (load(alpha_grads, p) + _product(grads, p * padded, row, channels))
                    later = load(behind, p)
                    store(behind, p, later + gain)
                    varies = blends & (unclamped < MAX_ALPHA)
                    grad_exponent = select(varies, gain - alphas * inverse * later, 0.0)
                    grad_x, grad_y = grad_exponent * dx, grad_exponent * dy
                    m, mx, my = m + grad_exponent, mx + grad_x, my + grad_y
                    mxx, mxy, myy = fma(grad_x, dx, mxx), fma(grad_x, dy, mxy), fma(grad_y, dy, myy)
                    if absgrad:
                        slope_x = fma(dx, number(2) * row[HALF_XX], dy * row[XY])
                        slope_y = fma(dx, row[XY], dy * (number(2) * row[HALF_YY]))
                        absolute_x = absolute_x + absolute(grad_exponent * slope_x)
                        absolute_y = absolute_y + absolute(grad_exponent * slope_y)
            offset = entry * parts.shape[1]
            if needs_colors:
                for c in range(0, padded, _GROUP):
                    _sum_channels(weights, grads, spans[entry, 0], spans[entry, 1], c, parts, offset + c)
            if needs_geometry:
                store_sums(parts, offset + padded, m, mx, my, mxx)
                store_sums(parts, offset + padded + 4, mxy, myy, absolute_x, absolute_y)


@inlined
def _product(grads: Any, at: int, row: Any, channels: int) -> Any:
    """<g, c> of WIDTH pixels; two sums, whose latencies overlap."""
    even = odd = zeros(grads)
    for c in range(0, channels, 2):
        even = fma(load(grads, at + c * WIDTH), row[_COLORS + c], even)
        if c + 1 < channels:
            odd = fma(load(grads, at + c * WIDTH + WIDTH), row[_COLORS + c + 1], odd)
    return even + odd


@inlined
def _sum_channels(weights: Any, grads: Any, first: int, beyond: int, channel: int, parts: Any, offset: int) -> None:
    """Write the sums, over the touched pixels of a tile, of weights times the gradients of four channels."""
    a = b = c = d = zeros(weights)
    for step in range(first, beyond):
        weight = load(weights, step * WIDTH)
        at = (step * grads.shape[1] + channel) * WIDTH
        a, b = fma(weight, load(grads, at), a), fma(weight, load(grads, at + WIDTH), b)
        c, d = fma(weight, load(grads, at + 2 * WIDTH), c), fma(weight, load(grads, at + 3 * WIDTH), d)
    store_sums(parts, offset, a, b, c, d)


@compiled
def _sum_entries(
    begin: int, end: int, shares: int, lists: Any, last: Any, parts: Any, padded: int, outputs: Any, absolute_grads: Any
) -> None:
    """Sum the blended entries of each Gaussian in float64, convert moments to gradients, and add them to the outputs.

    The Gaussians are cut into ``shares``; these are numbers ``begin`` to ``end`` of them.
    """
    _, _, starts, ranks, _, ids, table = lists
    grad_means2d, grad_conics, grad_opacities, grad_colors = outputs
    first, beyond = len(ids) * begin // shares, len(ids) * end // shares
    sums: Any = np.zeros((beyond - first, parts.shape[1]))
    for tile in range(len(starts) - 1):
        blended = min(starts[tile + 1] - starts[tile], int(last[tile].max()))
        for entry in range(starts[tile], starts[tile] + blended):
            if first <= ranks[entry] < beyond:
                for d in range(parts.shape[1]):
                    sums[ranks[entry] - first, d] += parts[entry, d]
    for rank in range(first, beyond):
        i, total = ids[rank], sums[rank - first]
        for c in range(grad_colors.shape[1]):
            grad_colors[i, c] += total[c]
        if len(total) == padded:  # only the colours have gradients
            continue
        xx, xy, yy = 2 * float(table[rank, HALF_XX]), table[rank, XY], 2 * float(table[rank, HALF_YY])
        mx, my = total[padded + 1], total[padded + 2]
        grad_means2d[0, i, 0] += xx * mx + xy * my
        grad_means2d[0, i, 1] += xy * mx + yy * my
        grad_conics[i, 0] -= 0.5 * total[padded + 3]
        grad_conics[i, 1] -= total[padded + 4]
        grad_conics[i, 2] -= 0.5 * total[padded + 5]
        grad_opacities[i] += total[padded] / table[rank, OPACITY]
        if len(absolute_grads) > 0:
            absolute_grads[0, i, 0] += total[padded + 6]
            absolute_grads[0, i, 1] += total[padded + 7]
