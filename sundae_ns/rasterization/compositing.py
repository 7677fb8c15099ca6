"""Front-to-back blending of tile lists, with an analytic backward pass of bounded memory.

Tiles with lists of similar length are blended together as padded arrays ``[T, M, P]`` (tiles, list entries, pixels) of
limited size. Long lists are cut into segments, so a tile whose pixels are all opaque is dropped early. The backward
pass keeps only the entries and the transmittance in front of each segment, and evaluates the rest again.

For pixel p and list entry m, with g the gradient of the loss with respect to the blended channels:

- alpha_m = min(0.999, exp(e_m)), where e_m is a quadratic polynomial of the pixel's position in its tile;
- T_m = prod over k < m of (1 - alpha_k), w_m = alpha_m T_m, and the image is sum_m w_m c_m;
- dL/de_m = w_m <g, c_m> - alpha_m / (1 - alpha_m) * sum over k > m of w_k <g, c_k>, and 0 where alpha is clamped.

Since e is linear in six coefficients, both passes are small matrix products around one exponential and two scans.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from sundae_ns.rasterization.tiles import MIN_ALPHA, TILE, TileLists, tile_centres

MAX_ALPHA = 0.999
"""Upper bound of alpha, so that no single primitive makes a pixel opaque."""

MIN_TRANSMITTANCE = 1e-4
"""A pixel is finished when its next primitive would leave no more transmittance than this; that one is not blended."""

_PIXELS = TILE * TILE
_SEGMENT = 128  # list entries between two checks for opaque tiles
_BATCH_ELEMENTS = 2**17  # elements of a [T, M, P] array: half a MiB in float32, which fits in the cache
_LENGTH_RATIO = 0.75  # shortest over longest list of a batch: padding wastes at most a quarter ...
_SMALL_BATCH = 2**15  # ... except in batches so small that the cost per call outweighs it
_FAINTEST = -20.0  # lower bound of exponents, far below log(1 / 255): exp() is ten times slower on denormals


@dataclass(frozen=True)
class _Batch:
    """One segment of the lists of several tiles."""

    tiles: Tensor  # [T]
    entries: Tensor  # [T, M]: positions in the lists; L, one past the end, marks padding
    transmittance: Tensor  # [T, P]: in front of the segment


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, lists: TileLists, absgrad: bool
    ) -> tuple[Tensor, Tensor]:
        basis = _pixel_basis(means2d)
        exponents = _exponents(_offsets(means2d, lists), conics, opacities, lists)
        channels, owners = _channels(colors), _owners(colors, lists)
        blended = colors.new_zeros(lists.columns * lists.rows, _PIXELS, channels.shape[1])
        batches = []
        for tiles in _groups(lists):
            transmittance, done = colors.new_ones(tiles.shape[0], _PIXELS), 0
            while tiles.shape[0] > 0:
                batch = _Batch(tiles, _segment(lists, tiles, done), transmittance)
                batches.append(batch)
                alphas = _alphas(_rows(exponents, batch.entries), basis)
                through = _transmittances(alphas, transmittance)
                weights = _weights(alphas, through)
                blended.index_add_(0, tiles, weights.mT @ _rows(channels, owners[batch.entries]))
                done += batch.entries.shape[1]
                behind = through[:, -1]
                unfinished = (lists.lengths[tiles] > done) & (behind > MIN_TRANSMITTANCE).any(dim=1)
                tiles, transmittance = tiles[unfinished], behind[unfinished]
        ctx.save_for_backward(means2d, conics, opacities, colors)
        ctx.lists, ctx.batches, ctx.absgrad = lists, batches, absgrad
        image = _from_tiles(blended, lists)
        return image[..., :-1].contiguous(), image[..., -1:].contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor) -> tuple[Tensor | None, ...]:
        means2d, conics, opacities, colors = ctx.saved_tensors
        lists: TileLists = ctx.lists
        needs_geometry, needs_colors = any(ctx.needs_input_grad[:3]), ctx.needs_input_grad[3]
        basis, offsets = _pixel_basis(means2d), _offsets(means2d, lists)
        exponents = _exponents(offsets, conics, opacities, lists)
        channels, owners = _channels(colors), _owners(colors, lists)
        grads = _to_tiles(torch.cat([grad_image, grad_alpha], dim=-1), lists)  # [tiles, P, C + 1]
        grad_channels = torch.zeros_like(channels)
        moments = torch.zeros_like(exponents)  # gradient of the exponents' coefficients
        absolute = exponents.new_zeros(exponents.shape[0], 2)
        may_clamp = bool((opacities >= MAX_ALPHA).any())
        behind = grads.new_zeros(grads.shape[:2])  # sum of w <g, c> over the later segments
        for batch in reversed(ctx.batches):
            tiles, ids, grad = batch.tiles, owners[batch.entries], grads[batch.tiles]
            coefficients = _rows(exponents, batch.entries)
            alphas = _alphas(coefficients, basis)
            weights = _weights(alphas, _transmittances(alphas, batch.transmittance))
            if needs_colors:
                grad_channels.index_add_(0, ids.flatten(), (weights @ grad).flatten(0, 1))
            if not needs_geometry:
                continue
            gains = weights.mul_(_rows(channels, ids) @ grad.mT)  # w <g, c>
            after = gains.cumsum(dim=1)
            total = after[:, -1] + behind[tiles]
            behind[tiles] = total
            torch.sub(total[:, None], after, out=after)
            grad_exponents = gains.sub_(after.mul_(alphas).div_(1 - alphas))  # dL/de
            if may_clamp:
                grad_exponents.mul_(torch.lt(alphas, MAX_ALPHA, out=after))
            moments[batch.entries] = grad_exponents @ basis.mT
            if ctx.absgrad:
                absolute[batch.entries] = _absolute_gradients(grad_exponents.abs_(), coefficients, basis)

        if ctx.absgrad:
            means2d.absgrad = _sum_by_owner(absolute[:-1], lists, means2d)[None]
        grad_colors = grad_channels[:-1, :-1] if needs_colors else None
        if not needs_geometry:
            return None, None, None, grad_colors, None, None
        shape = _shape_gradients(moments[:-1], offsets, conics[lists.gaussian_ids])
        summed = _sum_by_owner(shape, lists, means2d)
        # Opacities below 1/255 are in no list, so the clamp changes no gradient.
        grad_opacities = summed[:, 5] / opacities.clamp(min=0.5 * MIN_ALPHA)
        return summed[None, :, :2], summed[:, 2:5], grad_opacities, grad_colors, None, None


composite = _Composite.apply
"""Blend to an image ``[H, W, C]`` and its alpha ``[H, W, 1]``; once differentiable.

It takes centres ``[1, N, 2]`` in pixels, conics ``[N, 3]``, opacities ``[N]``, colours ``[N, C]``, the tile
lists, and ``absgrad``. With it the backward pass sets ``absgrad`` ``[1, N, 2]`` of the centres: the absolute gradient
of each pixel with respect to the centre, summed over the pixels (Ye et al., "AbsGS", 2024).
"""


def _groups(lists: TileLists) -> Iterator[Tensor]:
    """Split the tiles with non-empty lists into batches of similar length and limited size."""
    lengths, order = torch.sort(lists.lengths, descending=True, stable=True)
    sizes = lengths.tolist()
    begin = 0
    while begin < len(sizes) and sizes[begin] > 0:
        per_tile = min(sizes[begin], _SEGMENT) * _PIXELS
        largest_end = begin + max(1, _BATCH_ELEMENTS // per_tile)
        small_end = begin + _SMALL_BATCH // per_tile
        end = begin + 1
        while end < min(largest_end, len(sizes)) and sizes[end] > 0:
            if end >= small_end and sizes[end] < _LENGTH_RATIO * sizes[begin]:
                break
            end += 1
        yield order[begin:end]
        begin = end


def _segment(lists: TileLists, tiles: Tensor, done: int) -> Tensor:
    """Positions ``[T, M]`` of the next entries of several tiles; padding is one past the end of all lists."""
    left = lists.lengths[tiles, None] - done
    steps = torch.arange(min(int(left.max()), _SEGMENT), device=tiles.device)
    return torch.where(steps < left, lists.starts[tiles, None] + done + steps, lists.gaussian_ids.shape[0])


def _rows(table: Tensor, index: Tensor) -> Tensor:
    """``table[index]`` for a table ``[R, D]`` and an index ``[T, M]``, several times faster on a CPU than indexing."""
    return table.index_select(0, index.flatten()).unflatten(0, index.shape)


def _pixel_basis(like: Tensor) -> Tensor:
    """Monomials 1, x, y, xx, xy, yy of each pixel centre relative to the tile's centre: ``[6, P]``."""
    place = torch.arange(TILE, dtype=like.dtype, device=like.device) - 0.5 * (TILE - 1)
    x, y = place.repeat(TILE), place.repeat_interleave(TILE)
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def _offsets(means2d: Tensor, lists: TileLists) -> Tensor:
    """Centres of the primitives relative to the centres of their tiles: ``[L, 2]``."""
    return means2d[0, lists.gaussian_ids] - tile_centres(lists.tile_ids, lists.columns)


def _exponents(offsets: Tensor, conics: Tensor, opacities: Tensor, lists: TileLists) -> Tensor:
    """Coefficients of the log of the unclamped alpha over the pixel basis ``[L + 1, 6]``; the last row is padding."""
    u, v = offsets.unbind(-1)
    xx, xy, yy = conics[lists.gaussian_ids].unbind(-1)
    x, y = xx * u + xy * v, xy * u + yy * v
    constant = opacities[lists.gaussian_ids].log() - 0.5 * (x * u + y * v)
    coefficients = torch.stack([constant, x, y, -0.5 * xx, -xy, -0.5 * yy], dim=-1)
    return torch.cat([coefficients, coefficients.new_tensor([[_FAINTEST, 0, 0, 0, 0, 0]])])


def _owners(colors: Tensor, lists: TileLists) -> Tensor:
    """Primitive of each list entry ``[L + 1]``; padding belongs to primitive N."""
    return pad(lists.gaussian_ids, (0, 1), value=colors.shape[0])


def _channels(colors: Tensor) -> Tensor:
    """Colours, a channel of ones that blends to the accumulated alpha, and a row for padding: ``[N + 1, C + 1]``."""
    return pad(pad(colors, (0, 1), value=1.0), (0, 0, 0, 1))


def _alphas(coefficients: Tensor, basis: Tensor) -> Tensor:
    """Alphas ``[T, M, P]``, clamped from above, and 0 where too faint."""
    exponents = (coefficients @ basis).clamp_(min=_FAINTEST)
    return torch.threshold_(exponents.exp_().clamp_(max=MAX_ALPHA), MIN_ALPHA, 0.0)


def _transmittances(alphas: Tensor, start: Tensor) -> Tensor:
    """Transmittance in front of each entry and behind the last: ``[T, M + 1, P]``."""
    factors = alphas.new_empty(alphas.shape[0], alphas.shape[1] + 1, alphas.shape[2])
    factors[:, 0] = start
    torch.sub(1.0, alphas, out=factors[:, 1:])
    return factors.cumprod_(dim=1)


def _weights(alphas: Tensor, through: Tensor) -> Tensor:
    """Blending weights ``[T, M, P]``.

    Transmittance never rises, so all entries behind the first that would leave too little leave too little too: the
    stopping rule needs no sequential scan.
    """
    weights = alphas * through[:, :-1]
    if (through[:, -1] <= MIN_TRANSMITTANCE).any():
        # Float masks, here and below: masked_fill() is ten times slower on a CPU.
        weights.mul_(torch.gt(through[:, 1:], MIN_TRANSMITTANCE, out=torch.empty_like(weights)))
    return weights


def _absolute_gradients(grad_exponents: Tensor, coefficients: Tensor, basis: Tensor) -> Tensor:
    """Sum over pixels of ``|dL/de| |de/dcentre|``: ``[T, M, 2]``, given ``|dL/de|`` as ``[T, M, P]``."""
    _, x, y, xx, xy, yy = coefficients.unbind(-1)
    # The exponent depends on pixel minus centre, so the two gradients have opposite signs.
    slopes = (torch.stack([-x, -2 * xx, -xy], dim=-1), torch.stack([-y, -xy, -2 * yy], dim=-1))
    return torch.stack([((slope @ basis[:3]).abs_() * grad_exponents).sum(dim=-1) for slope in slopes], dim=-1)


def _shape_gradients(moments: Tensor, offsets: Tensor, conics: Tensor) -> Tensor:
    """Gradients of centre (2), conic (3) and log opacity (1), ``[L, 6]``, from those of the coefficients."""
    m, mx, my, mxx, mxy, myy = moments.unbind(-1)
    u, v = offsets.unbind(-1)
    xx, xy, yy = conics.unbind(-1)
    # Moments about the primitive's centre instead of the tile's.
    dx, dy = mx - u * m, my - v * m
    dxx = mxx - u * (mx + dx)
    dyy = myy - v * (my + dy)
    dxy = mxy - v * mx - u * dy
    return torch.stack([xx * dx + xy * dy, xy * dx + yy * dy, -0.5 * dxx, -dxy, -0.5 * dyy, m], dim=-1)


def _sum_by_owner(values: Tensor, lists: TileLists, means2d: Tensor) -> Tensor:
    """Sum values ``[L, D]`` over the entries of each primitive: ``[N, D]``."""
    return values.new_zeros(means2d.shape[1], values.shape[1]).index_add_(0, lists.gaussian_ids, values)


def _from_tiles(tiles: Tensor, lists: TileLists) -> Tensor:
    """Assemble tiles ``[tiles, P, D]`` to an image ``[H, W, D]``."""
    grid = tiles.reshape(lists.rows, lists.columns, TILE, TILE, -1).transpose(1, 2)
    return grid.reshape(lists.rows * TILE, lists.columns * TILE, -1)[: lists.height, : lists.width]


def _to_tiles(image: Tensor, lists: TileLists) -> Tensor:
    """Cut an image ``[H, W, D]`` into tiles ``[tiles, P, D]``, zero outside the image."""
    right, bottom = lists.columns * TILE - lists.width, lists.rows * TILE - lists.height
    grid = pad(image, (0, 0, 0, right, 0, bottom)).reshape(lists.rows, TILE, lists.columns, TILE, -1).transpose(1, 2)
    return grid.reshape(-1, _PIXELS, image.shape[2])
