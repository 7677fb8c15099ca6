"""Depth-ordered lists of the primitives of each tile, by the rule of :mod:`sundae_ns.rasterization.tiles`.

Primitives are sorted by depth once; from then on a primitive goes by its rank. It owns a run of slots, one for each tile that
it can touch, and the list of a tile is a list of slots. What the derivatives add up per tile lies in the slots, so that
the sum over a primitive's tiles is one over neighbours in memory, always in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, sqrt
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sundae_ns.rasterization.cpu.lanes import WIDTH
from sundae_ns.rasterization.cpu.parallel import as_array, compiled, share
from sundae_ns.rasterization.projection import Projection
from sundae_ns.rasterization.tiles import BIN, MIN_ALPHA, ROUNDING, TILE

U, V, HALF_XX, XY, HALF_YY, OPACITY, LIMIT, HALF_WIDTH, HALF_HEIGHT = range(9)
"""Columns of the table: centre, conic, opacity, the largest exponent that counts, and how far from the centre it occurs."""

STEP = WIDTH // TILE
"""Rows of pixels of a tile that are blended in one step."""

_WORTH_A_THREAD = 2_500  # primitives: below a tenth of a millisecond, waking a thread costs more than it saves
_DIGIT = 11  # bits that one pass of the sort looks at


@dataclass(frozen=True)
class Lists:
    """V visible primitives in T tiles, row by row; L slots."""

    columns: int
    rows: int
    ids: Any  # [V], int32: primitive of each rank
    table: Any  # [V, 9]: see the names of the columns
    first_slots: Any  # [V + 1], int64: the slots of a rank begin here
    starts: Any  # [T + 1], int64: the list of a tile begins here
    ranks: Any  # [L], int32: in the order of the lists
    slots: Any  # [L], int32: in the order of the lists
    spans: Any  # [L, 2], uint8, in the order of the lists: the steps of a tile that are touched, from one to before another
    busiest: Any  # [B], int32: tiles with a list, the longest first

    def for_blending(self) -> tuple[Any, ...]:
        """What loops over the tiles look at, both ways."""
        return self.columns, self.busiest, self.starts, self.ranks, self.spans, self.ids, self.table


@torch.no_grad()
def build_lists(projection: Projection, opacities: Tensor, width: int, height: int) -> Lists:
    """List the primitives of each tile; ``opacities`` ``[N]`` are those that will be blended."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    depths, radii, opacity = (as_array(value) for value in (projection.depths, projection.radii, opacities))
    # Bits of positive floats are in the order of the floats.
    keys = depths.view(np.uint32 if depths.dtype == np.float32 else np.uint64)
    ids = _visible_by_depth(keys, radii, opacity)
    count = len(ids)
    table, boxes = np.empty((count, 9), depths.dtype), np.empty((count, 4), np.int32)
    first_bands, first_slots = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    inputs = [as_array(value) for value in (projection.means2d, projection.covars2d, projection.conics)]
    measured = (ids, *inputs, radii, opacity, columns, rows, table, boxes, first_bands)
    share(_measure, count, *measured, at_least=_WORTH_A_THREAD)
    np.cumsum(first_bands, out=first_bands)
    bands = np.empty((first_bands[-1], 2), np.int32)
    share(_find_bands, count, table, boxes, first_bands, bands, first_slots, at_least=_WORTH_A_THREAD)
    np.cumsum(first_slots, out=first_slots)
    starts, ranks, slots, spans = _sort_by_tile(boxes, first_bands, bands, first_slots, columns, rows)
    lengths = np.diff(starts)
    busiest = np.argsort(-lengths, kind="stable").astype(np.int32)[: np.count_nonzero(lengths)]
    return Lists(columns, rows, ids, table, first_slots, starts, ranks, slots, spans, busiest)


@compiled
def _visible_by_depth(keys: Any, radii: Any, opacities: Any) -> Any:
    """Primitives that can be seen, nearest first, ties by index: a radix sort from the last digit to the first."""
    smallest = opacities.dtype.type(MIN_ALPHA)
    ids = np.empty(len(keys), np.int32)
    count = 0
    for i in range(len(keys)):
        if radii[i] > 0 and opacities[i] >= smallest:
            ids[count] = i
            count += 1
    ids = ids[:count].copy()
    other = np.empty_like(ids)
    ends: Any = np.empty(1 << _DIGIT, np.int64)
    for shift in range(0, 8 * keys.itemsize, _DIGIT):
        ends[:] = 0
        for i in ids:
            ends[(np.int64(keys[i]) >> shift) & ((1 << _DIGIT) - 1)] += 1
        total: Any = 0
        for digit in range(1 << _DIGIT):
            size = ends[digit]
            ends[digit] = total
            total += size
        for i in ids:
            place = (np.int64(keys[i]) >> shift) & ((1 << _DIGIT) - 1)
            other[ends[place]] = i
            ends[place] += 1
        ids, other = other, ids
    return ids


@compiled
def _measure(
    begin: int,
    end: int,
    ids: Any,
    means2d: Any,
    covars2d: Any,
    conics: Any,
    radii: Any,
    opacities: Any,
    columns: int,
    rows: int,
    table: Any,
    boxes: Any,
    counts: Any,
) -> None:
    """Write a row of the table, the rectangle of tiles to look at, and at rank + 1 how many columns it has."""
    number = table.dtype.type
    per_bin = BIN // TILE
    for rank in range(begin, end):
        i = ids[rank]
        radius = number(radii[i])
        known = abs(float(means2d[i, 0]) + means2d[i, 1] + conics[i, 0] + conics[i, 1] + conics[i, 2]) < np.inf
        reach = number(log(opacities[i] / number(MIN_ALPHA))) + number(ROUNDING)
        for axis in range(2):
            centre = means2d[i, axis]
            half = number(sqrt(number(2) * reach * covars2d[i, 2 * axis]))
            low = max(np.floor((centre - radius) / BIN) * per_bin, np.floor((centre - half) / TILE))
            high = min(np.ceil((centre + radius) / BIN) * per_bin, np.ceil((centre + half) / TILE))
            most = columns if axis == 0 else rows
            boxes[rank, axis] = np.int32(min(max(low, 0), most))
            boxes[rank, 2 + axis] = np.int32(min(max(high, 0), most))
            table[rank, HALF_WIDTH + axis] = half
        table[rank, U], table[rank, V] = means2d[i, 0], means2d[i, 1]
        table[rank, HALF_XX] = number(0.5) * conics[i, 0]
        table[rank, XY] = conics[i, 1]
        table[rank, HALF_YY] = number(0.5) * conics[i, 2]
        table[rank, OPACITY], table[rank, LIMIT] = opacities[i], reach
        if not known:
            boxes[rank] = 0
        counts[rank + 1] = max(boxes[rank, 2] - boxes[rank, 0], 0)


@compiled
def _find_bands(begin: int, end: int, table: Any, boxes: Any, first_bands: Any, bands: Any, counts: Any) -> None:
    """Write the rows of pixels that a rank touches in each column of tiles, and at rank + 1 the number of tiles."""
    for rank in range(begin, end):
        first_row, end_row = boxes[rank, 1] * TILE, boxes[rank, 3] * TILE
        tiles = 0
        for column in range(boxes[rank, 0], boxes[rank, 2]):
            low, high = _touched(table, rank, column * TILE)
            # No number, of footprints beyond all numbers, is as far as can be.
            first = np.int64(min(np.ceil(low), end_row)) if low > first_row else first_row
            beyond = np.int64(max(np.floor(high) + 1, first_row)) if high < end_row - 1 else end_row
            band = first_bands[rank] + column - boxes[rank, 0]
            bands[band, 0], bands[band, 1] = first, beyond
            tiles += _tiles_of(first, beyond)
        counts[rank + 1] = tiles


@compiled
def _tiles_of(first: int, beyond: int) -> int:
    """How many tiles have rows of pixels from ``first`` to before ``beyond``."""
    return (beyond - 1) // TILE - first // TILE + 1 if beyond > first else 0


@compiled
def _touched(table: Any, rank: int, left: int) -> tuple[float, float]:
    """The lowest and the highest place, in rows of pixels, of exponents that count within a column of tiles.

    They are those inside of an ellipse, from ``slope dx - rise`` to ``slope dx + rise`` at ``dx`` from its centre. Where
    its top is outside of the column, the highest place is on the edge that is nearer to it; the bottom lies opposite.
    """
    xx, xy, yy = float(table[rank, HALF_XX]), float(table[rank, XY]), float(table[rank, HALF_YY])
    half_width, half_height = float(table[rank, HALF_WIDTH]), float(table[rank, HALF_HEIGHT])
    begin, end = left + 0.5 - table[rank, U], left + TILE - 0.5 - table[rank, U]
    if begin > half_width or end < -half_width:
        return 1.0, 0.0
    begin, end = max(begin, -half_width), min(end, half_width)
    slope, steepest = -0.5 * xy / yy, table[rank, LIMIT] / yy
    top = -0.5 * xy / xx * half_height
    above, below = min(max(top, begin), end), min(max(-top, begin), end)
    centre = table[rank, V] - 0.5
    low = centre + slope * below - sqrt(steepest * max(1 - (below / half_width) ** 2, 0.0))
    high = centre + slope * above + sqrt(steepest * max(1 - (above / half_width) ** 2, 0.0))
    return low, high


@compiled
def _sort_by_tile(
    boxes: Any, first_bands: Any, bands: Any, first_slots: Any, columns: int, rows: int
) -> tuple[Any, Any, Any, Any]:
    """Slots, their ranks and their rows of pixels, in the order of the tiles, by rank in each; and where each tile begins."""
    starts: Any = np.zeros(columns * rows + 1, np.int64)
    for rank in range(len(first_bands) - 1):
        for band in range(first_bands[rank], first_bands[rank + 1]):
            column = boxes[rank, 0] + band - first_bands[rank]
            row = bands[band, 0] // TILE
            for _ in range(_tiles_of(bands[band, 0], bands[band, 1])):
                starts[row * columns + column + 1] += 1
                row += 1
    for tile in range(columns * rows):
        starts[tile + 1] += starts[tile]
    count = first_slots[-1]
    ranks, slots, spans = np.empty(count, np.int32), np.empty(count, np.int32), np.empty((count, 2), np.uint8)
    ends: Any = starts.copy()
    slot = 0
    for rank in range(len(first_bands) - 1):
        for band in range(first_bands[rank], first_bands[rank + 1]):
            first, beyond = bands[band, 0], bands[band, 1]
            column = boxes[rank, 0] + band - first_bands[rank]
            row = first // TILE
            for _ in range(_tiles_of(first, beyond)):
                tile = row * columns + column
                place = ends[tile]
                ranks[place], slots[place] = rank, slot
                spans[place, 0] = max(first - row * TILE, 0) // STEP
                spans[place, 1] = (min(beyond - row * TILE, TILE) + STEP - 1) // STEP
                ends[tile] += 1
                slot += 1
                row += 1
    return starts, ranks, slots, spans
