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

from sundae_ns.rasterization.cpu.parallel import as_array, compiled, share
from sundae_ns.rasterization.projection import Projection
from sundae_ns.rasterization.tiles import BIN, MIN_ALPHA, ROUNDING, TILE

U, V, HALF_XX, XY, HALF_YY, OPACITY, LIMIT = range(7)
"""Columns of the table: centre, conic, opacity, and the largest exponent that counts."""

_WORTH_A_THREAD = 10_000  # primitives: below a millisecond, waking a thread costs more than it saves
_DIGIT = 11  # bits that one pass of the sort looks at


@dataclass(frozen=True)
class Lists:
    """V visible primitives in T tiles, row by row; L slots."""

    columns: int
    rows: int
    ids: Any  # [V], int32: primitive of each rank
    table: Any  # [V, 7]: see the names of the columns
    first_slots: Any  # [V + 1], int64: the slots of a rank begin here
    starts: Any  # [T + 1], int64: the list of a tile begins here
    ranks: Any  # [L], int32: in the order of the lists
    slots: Any  # [L], int32: in the order of the lists
    busiest: Any  # [B], int32: tiles with a list, the longest first


@torch.no_grad()
def build_lists(projection: Projection, opacities: Tensor, width: int, height: int) -> Lists:
    """List the primitives of each tile; ``opacities`` ``[N]`` are those that will be blended."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    depths, radii, opacity = (as_array(value) for value in (projection.depths, projection.radii, opacities))
    # Bits of positive floats are in the order of the floats.
    keys = depths.view(np.uint32 if depths.dtype == np.float32 else np.uint64)
    ids = _visible_by_depth(keys, radii, opacity)
    count = len(ids)
    table, spans = np.empty((count, 7), depths.dtype), np.empty((count, 4), np.int32)
    first_slots = np.zeros(count + 1, np.int64)
    inputs = [as_array(value) for value in (projection.means2d, projection.covars2d, projection.conics)]
    share(
        _measure,
        count,
        ids,
        *inputs,
        radii,
        opacity,
        columns,
        rows,
        table,
        spans,
        first_slots,
        at_least=_WORTH_A_THREAD,
    )
    np.cumsum(first_slots, out=first_slots)
    cells = np.empty(first_slots[-1], np.int32)
    share(_cells, count, table, spans, first_slots, columns, cells, at_least=_WORTH_A_THREAD)
    starts, ranks, slots = _sort_by_cell(cells, first_slots, columns * rows)
    lengths = np.diff(starts)
    busiest = np.argsort(-lengths, kind="stable").astype(np.int32)[: np.count_nonzero(lengths)]
    return Lists(columns, rows, ids, table, first_slots, starts, ranks, slots, busiest)


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
    spans: Any,
    counts: Any,
) -> None:
    """Write a row of the table, the rectangle of tiles to look at, and at rank + 1 how many of them are touched."""
    number = table.dtype.type
    per_bin = BIN // TILE
    for rank in range(begin, end):
        i = ids[rank]
        radius = number(radii[i])
        reach = number(log(opacities[i] / number(MIN_ALPHA))) + number(ROUNDING)
        for axis in range(2):
            centre = means2d[i, axis]
            half = number(sqrt(number(2) * reach * covars2d[i, 2 * axis]))
            low = max(np.floor((centre - radius) / BIN) * per_bin, np.floor((centre - half) / TILE))
            high = min(np.ceil((centre + radius) / BIN) * per_bin, np.ceil((centre + half) / TILE))
            most = columns if axis == 0 else rows
            spans[rank, axis] = np.int32(min(max(low, 0), most))
            spans[rank, 2 + axis] = np.int32(min(max(high, 0), most))
        table[rank, U], table[rank, V] = means2d[i, 0], means2d[i, 1]
        table[rank, HALF_XX] = number(0.5) * conics[i, 0]
        table[rank, XY] = conics[i, 1]
        table[rank, HALF_YY] = number(0.5) * conics[i, 2]
        table[rank, OPACITY], table[rank, LIMIT] = opacities[i], reach
        touched = 0
        for top in range(spans[rank, 1], spans[rank, 3]):
            for left in range(spans[rank, 0], spans[rank, 2]):
                touched += _touches(table, rank, left, top)
        counts[rank + 1] = touched


@compiled
def _touches(table: Any, rank: int, left: int, top: int) -> bool:
    """Whether an exponent that counts occurs in the box of a tile's pixel centres.

    Half the squared Mahalanobis distance is convex, so off the box its minimum lies on an edge that faces the centre.
    """
    number = table.dtype.type
    x0, y0 = number(left * TILE) - table[rank, U] + number(0.5), number(top * TILE) - table[rank, V] + number(0.5)
    x1, y1 = x0 + number(TILE - 1), y0 + number(TILE - 1)
    xx, xy, yy = table[rank, HALF_XX], table[rank, XY], table[rank, HALF_YY]
    near_x, near_y = max(x0, number(0)) + min(x1, number(0)), max(y0, number(0)) + min(y1, number(0))
    best_x = min(max(-xy * near_y / (number(2) * xx), x0), x1)
    best_y = min(max(-xy * near_x / (number(2) * yy), y0), y1)
    beside = xx * near_x * near_x + yy * best_y * best_y + xy * near_x * best_y
    above = xx * best_x * best_x + yy * near_y * near_y + xy * best_x * near_y
    return min(beside, above) <= table[rank, LIMIT]


@compiled
def _cells(begin: int, end: int, table: Any, spans: Any, first_slots: Any, columns: int, cells: Any) -> None:
    """Write the touched tiles of each rank, in the order of its slots."""
    for rank in range(begin, end):
        slot = first_slots[rank]
        for top in range(spans[rank, 1], spans[rank, 3]):
            for left in range(spans[rank, 0], spans[rank, 2]):
                if _touches(table, rank, left, top):
                    cells[slot] = top * columns + left
                    slot += 1


@compiled
def _sort_by_cell(cells: Any, first_slots: Any, count: int) -> tuple[Any, Any, Any]:
    """Slots and their ranks in the order of the tiles, by rank in each; and where each tile begins."""
    starts = np.zeros(count + 1, np.int64)
    for cell in cells:
        starts[cell + 1] += 1
    for cell in range(count):
        starts[cell + 1] += starts[cell]
    ranks, slots = np.empty(len(cells), np.int32), np.empty(len(cells), np.int32)
    ends = starts.copy()
    for rank in range(len(first_slots) - 1):
        for slot in range(first_slots[rank], first_slots[rank + 1]):
            place = ends[cells[slot]]
            ranks[place], slots[place] = rank, slot
            ends[cells[slot]] += 1
    return starts, ranks, slots
