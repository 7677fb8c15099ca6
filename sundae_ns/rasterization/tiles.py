"""Depth-ordered lists of the primitives that can touch each tile of the image.

gsplat 1.4 bins primitives into 16-pixel tiles by their three-sigma square and blends them in every pixel of those
tiles. So its images depend on that grid. The lists here use a finer grid and leave out only primitives that cannot
reach an alpha of 1/255 in a tile: the image is that of the 16-pixel grid, with fewer evaluations. (gsplat 1.5 fits the
bins to the opacity instead, which also keeps the rim of opaque primitives from 3 to 3.33 sigma.)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.rasterization.limits import check_pairs
from sundae_ns.rasterization.projection import Projection

TILE = 8
"""Side of a tile in pixels."""

MIN_ALPHA = 1.0 / 255.0
"""Contributions fainter than this are skipped."""

BIN = 16  # side of gsplat's tiles
_PAIR_BYTES = 100  # of the table, its columns and the exponents
ROUNDING = 1e-3  # slack on exponents, so that rounding never drops a primitive that is blended


@dataclass(frozen=True)
class TileLists:
    """Pairs of a tile and a primitive, sorted by tile (row-major), then by depth, then by index."""

    width: int  # of the image, pixels
    height: int
    columns: int
    rows: int
    gaussian_ids: Tensor  # [L], int64
    tile_ids: Tensor  # [L], int64
    starts: Tensor  # [columns * rows], int64: start of each tile's list
    lengths: Tensor  # [columns * rows], int64


@torch.no_grad()
def build_tile_lists(projection: Projection, opacities: Tensor, width: int, height: int) -> TileLists:
    """List the primitives of each tile; ``opacities`` ``[N]`` are those to blend.

    Raises:
        MemoryExhaustedError: the lists would be too long.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    visible = ((projection.radii > 0) & (opacities >= MIN_ALPHA)).nonzero()[:, 0]
    ids = visible[projection.depths[visible].argsort(stable=True)]
    centres, covars = projection.means2d[ids], projection.covars2d[ids]
    reach = torch.log(opacities[ids] / MIN_ALPHA) + ROUNDING  # largest exponent that is still blended

    half = (2 * reach[:, None] * covars[:, [0, 2]]).sqrt()
    radii = projection.radii[ids, None].to(centres.dtype)
    per_bin = BIN // TILE
    low = torch.maximum(((centres - radii) / BIN).floor() * per_bin, ((centres - half) / TILE).floor())
    high = torch.minimum(((centres + radii) / BIN).ceil() * per_bin, ((centres + half) / TILE).ceil())
    grid = centres.new_tensor([columns, rows])
    low, high = low.clamp(min=0).minimum(grid), high.clamp(min=0).minimum(grid)
    spans = (high - low).clamp(min=0).long()

    # One row per tile of each primitive's rectangle of tiles, in order of depth.
    counts = spans[:, 0] * spans[:, 1]
    if ids.device.type == "cpu":
        training = projection.means2d.requires_grad
        check_pairs(int(counts.sum()), len(ids), columns * rows, _PAIR_BYTES, training=training)
    owner = torch.repeat_interleave(counts)
    within = torch.arange(owner.shape[0], device=ids.device) - (counts.cumsum(0) - counts).index_select(0, owner)
    width_of = spans[:, 0].index_select(0, owner)
    down = torch.div(within, width_of, rounding_mode="floor")
    across = within - down * width_of
    table = torch.cat([low, centres, projection.conics[ids], reach[:, None]], dim=-1).index_select(0, owner)
    left, top, u, v, xx, xy, yy, limit = table.unbind(-1)
    left, top = left + across, top + down

    touches = (_least_exponent(left * TILE - u, top * TILE - v, xx, xy, yy) <= limit).nonzero()[:, 0]
    cells = top.long() * columns + left.long()
    tile_ids, order = torch.sort(cells.index_select(0, touches), stable=True)
    gaussian_ids = ids.index_select(0, owner.index_select(0, touches.index_select(0, order)))
    lengths = torch.bincount(tile_ids, minlength=columns * rows)
    return TileLists(width, height, columns, rows, gaussian_ids, tile_ids, lengths.cumsum(0) - lengths, lengths)


def tile_centres(tile_ids: Tensor, columns: int) -> Tensor:
    """Centres of tiles in pixels, int64 ``[..., 2]``."""
    return torch.stack([tile_ids % columns, tile_ids // columns], dim=-1) * TILE + TILE // 2


def _least_exponent(left: Tensor, top: Tensor, xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
    """Minimum of half the squared Mahalanobis distance over a tile with its corner at (left, top): ``[L]``.

    The minimum is over the box of the tile's pixel centres. The distance is convex, so if the centre is outside the
    box, the minimum lies on an edge that faces the centre: the nearer vertical or the nearer horizontal one.
    """
    x0, y0 = left + 0.5, top + 0.5
    x1, y1 = x0 + (TILE - 1), y0 + (TILE - 1)
    near_x, near_y = x0.clamp(min=0) + x1.clamp(max=0), y0.clamp(min=0) + y1.clamp(max=0)
    best_x = (-xy / xx * near_y).maximum(x0).minimum(x1)
    best_y = (-xy / yy * near_x).maximum(y0).minimum(y1)
    return torch.minimum(_exponent(xx, xy, yy, near_x, best_y), _exponent(xx, xy, yy, best_x, near_y))


def _exponent(xx: Tensor, xy: Tensor, yy: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    return 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
