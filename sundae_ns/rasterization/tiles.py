"""Depth-ordered lists of the primitives that can touch each tile of the image.

gsplat bins primitives into 16-pixel tiles by their three-sigma square and blends them in every pixel of those tiles, so
its images depend on that grid. The lists here are on a finer grid, and leave out only what cannot reach an alpha of 1/255
in a tile: blending them gives the image of the 16-pixel grid with fewer pixels looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.rasterization.projection import Projection

TILE = 8
"""Side of a tile in pixels."""

MIN_ALPHA = 1.0 / 255.0
"""Fainter contributions to a pixel are skipped."""

_BIN = 16  # side of gsplat's tiles
_ROUNDING = 1e-3  # slack on exponents, so that rounding here never drops what the blending would still count


@dataclass(frozen=True)
class TileLists:
    """Pairs of a tile and a primitive, sorted by tile (row-major), then by depth, then by index."""

    columns: int
    rows: int
    gaussian_ids: Tensor  # [L], int64
    tile_ids: Tensor  # [L], int64
    starts: Tensor  # [columns * rows], int64: where the list of each tile begins
    lengths: Tensor  # [columns * rows], int64


@torch.no_grad()
def build_tile_lists(projection: Projection, opacities: Tensor, width: int, height: int) -> TileLists:
    """List the primitives of each tile; ``opacities`` ``[N]`` are those that will be blended."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    visible = ((projection.radii > 0) & (opacities >= MIN_ALPHA)).nonzero()[:, 0]
    ids = visible[projection.depths[visible].argsort(stable=True)]
    centres, covars = projection.means2d[ids], projection.covars2d[ids]
    reach = torch.log(opacities[ids] / MIN_ALPHA) + _ROUNDING  # largest exponent that still counts

    half = (2 * reach[:, None] * covars[:, [0, 2]]).sqrt()
    radii = projection.radii[ids, None].to(centres.dtype)
    per_bin = _BIN // TILE
    low = torch.maximum(((centres - radii) / _BIN).floor() * per_bin, ((centres - half) / TILE).floor())
    high = torch.minimum(((centres + radii) / _BIN).ceil() * per_bin, ((centres + half) / TILE).ceil())
    grid = centres.new_tensor([columns, rows])
    low = low.clamp(min=0).minimum(grid).long()
    spans = (high.clamp(min=0).minimum(grid).long() - low).clamp(min=0)

    counts = spans[:, 0] * spans[:, 1]
    owner = torch.repeat_interleave(torch.arange(ids.shape[0], device=ids.device), counts)
    within = torch.arange(owner.shape[0], device=ids.device) - (counts.cumsum(0) - counts)[owner]
    width_of = spans[owner, 0]
    cells = low[owner] + torch.stack([within % width_of, within // width_of], dim=-1)  # [L, 2]

    touches = _least_exponent(centres[owner], projection.conics[ids][owner], cells) <= reach[owner]
    cells, owner = cells[touches], owner[touches]
    tile_ids, order = torch.sort(cells[:, 1] * columns + cells[:, 0], stable=True)
    lengths = torch.bincount(tile_ids, minlength=columns * rows)
    return TileLists(columns, rows, ids[owner[order]], tile_ids, lengths.cumsum(0) - lengths, lengths)


def tile_centres(tile_ids: Tensor, columns: int) -> Tensor:
    """Centres of tiles in pixels, int64 ``[..., 2]``."""
    return torch.stack([tile_ids % columns, tile_ids // columns], dim=-1) * TILE + TILE // 2


def _least_exponent(centres: Tensor, conics: Tensor, cells: Tensor) -> Tensor:
    """Minimum over the pixel centres' bounding box of half the squared Mahalanobis distance: ``[L]``.

    The distance is convex, so off the box its minimum lies on an edge that faces the centre: the nearer vertical or the
    nearer horizontal one.
    """
    low = cells * TILE + 0.5 - centres
    high = low + (TILE - 1)
    near = torch.zeros_like(low).clamp(min=low, max=high)
    xx, xy, yy = conics.unbind(-1)
    best_y = (-xy / yy * near[:, 0]).clamp(min=low[:, 1], max=high[:, 1])
    best_x = (-xy / xx * near[:, 1]).clamp(min=low[:, 0], max=high[:, 0])
    return torch.minimum(
        _exponent(xx, xy, yy, near[:, 0], best_y),
        _exponent(xx, xy, yy, best_x, near[:, 1]),
    )


def _exponent(xx: Tensor, xy: Tensor, yy: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    return 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
