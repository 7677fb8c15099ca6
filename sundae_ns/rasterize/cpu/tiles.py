"""Depth-ordered lists of the Gaussians of each tile.

gsplat 1.4 blends a Gaussian in every 16-pixel tile that its three-sigma square touches, so its images depend on that
grid. The lists here use a finer grid and leave out only Gaussians that cannot reach an alpha of 1/255 in a tile: the
image is the same, with fewer evaluations. (gsplat 1.5 fits the squares to the opacity instead, which also keeps the rim
of opaque Gaussians from 3 to 3.33 sigma.)

Gaussians are sorted by depth once and are then identified by their rank, which ascends in each list. The backward pass
writes sums per tile in list order, so that the sum over the tiles of a Gaussian has a fixed order.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import log, sqrt
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from sundae_ns.rasterize.cpu.lanes import WIDTH
from sundae_ns.rasterize.cpu.parallel import as_array, compiled, parallel_for
from sundae_ns.rasterize.reference import BIN, MIN_ALPHA, Projection
from sundae_ns.rasterize.types import check_pairs

TILE = 8  # Side of a tile in pixels

U, V, HALF_XX, XY, HALF_YY, OPACITY, LIMIT, HALF_WIDTH, HALF_HEIGHT = range(9)
"""Columns of the table: centre, conic, opacity, largest exponent that is blended, and its distance from the centre."""

STEP = WIDTH // TILE  # Rows of pixels of a tile that are blended in one step
ROUNDING = 1e-3  # Slack on exponents, so that rounding never drops a Gaussian that is blended
MOST_PAIRS = 1 << 23
"""Pairs of a tile and a Gaussian in memory at a time: 50 MB, and in a backward pass at least three times as much."""
MIN_PER_THREAD = 2_500  # Gaussians: below 0.1 ms of work, waking a thread costs more than it saves
_DIGIT_BITS = 11  # bits per pass of the radix sort


class Lists(NamedTuple):
    """V visible Gaussians in those of the T tiles of an image, row by row, that are in a region; L pairs of both."""

    columns: int
    longest_first: Any  # [B], int32: tiles with a list, the longest first
    starts: Any  # [T + 1], int64: start of each tile's list
    ranks: Any  # [L], int32, in list order
    spans: Any  # [L, 2], uint8, in list order: the steps of a tile that are touched, the last excluded
    ids: Any  # [V], int32: Gaussian of each rank
    table: Any  # [V, 9]: see the column names above


def tile_lists(projection: Projection, opacities: Tensor, width: int, height: int) -> Iterator[Lists]:
    """List the Gaussians of each tile; ``opacities`` ``[N]`` are those to blend.

    An image with more than :data:`MOST_PAIRS` is halved until each region has fewer, or is a single tile. Without
    gradients one with more Gaussians than any real scene is a ``MemoryExhaustedError``.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    depths, radii, opacity = (as_array(value) for value in (projection.depths, projection.radii, opacities))
    splats = (*map(as_array, (projection.means2d, projection.covars2d, projection.conics)), radii, opacity)
    # The bits of positive floats have the order of the floats.
    keys = depths.view(np.uint32 if depths.dtype == np.float32 else np.uint64)
    ids = _visible_by_depth(keys, radii, opacity)
    count = len(ids)
    listed = 0
    regions = [(0, 0, columns, rows)]
    while regions:
        region = regions.pop()
        table = np.empty((count, 9), depths.dtype)
        boxes = np.empty((count, 4), np.int32)
        first_intervals, num_tiles = np.zeros((2, count + 1), np.int64)
        parallel_for(_measure, count, ids, splats, region, table, boxes, first_intervals, min_per_thread=MIN_PER_THREAD)
        np.cumsum(first_intervals, out=first_intervals)
        halves = _halves(*region)
        pairs = int(first_intervals[-1])  # a Gaussian touches at least one tile in each of its columns
        if pairs <= MOST_PAIRS or not halves:
            intervals = np.empty((pairs, 2), np.int32)
            touched = (table, boxes, first_intervals, intervals, num_tiles)
            parallel_for(_find_intervals, count, *touched, min_per_thread=MIN_PER_THREAD)
            pairs = int(num_tiles.sum())
        if not projection.means2d.requires_grad:
            check_pairs(listed + pairs, count, columns * rows)
        if pairs > MOST_PAIRS and halves:
            regions += halves
            continue
        listed += pairs
        starts, ranks, spans = _sort_by_tile(boxes, first_intervals, intervals, columns, rows)
        lengths = np.diff(starts)
        longest_first = np.argsort(-lengths, kind="stable").astype(np.int32)[: np.count_nonzero(lengths)]
        yield Lists(columns, longest_first, starts, ranks, spans, ids, table)


def _halves(left: int, top: int, right: int, bottom: int) -> list[tuple[int, int, int, int]]:
    """A region of tiles cut across its longer side; nothing for a single tile."""
    x, y = (left + right) // 2, (top + bottom) // 2
    if right - left > bottom - top:
        return [(left, top, x, bottom), (x, top, right, bottom)]
    return [(left, top, right, y), (left, y, right, bottom)] if bottom - top > 1 else []


@compiled
def _visible_by_depth(keys: Any, radii: Any, opacities: Any) -> Any:
    """Visible Gaussians, nearest first, ties by index: a radix sort from the last digit to the first."""
    smallest = opacities.dtype.type(MIN_ALPHA)
    ids = np.empty(len(keys), np.int32)
    count = 0
    for i in range(len(keys)):
        if radii[i] > 0 and opacities[i] >= smallest:
            ids[count] = i
            count += 1
    ids, other = ids[:count].copy(), np.empty(count, np.int32)
    ends: Any = np.empty(1 << _DIGIT_BITS, np.int64)
    for shift in range(0, 8 * keys.itemsize, _DIGIT_BITS):
        ends[:] = 0
        for i in ids:
            ends[(np.int64(keys[i]) >> shift) & ((1 << _DIGIT_BITS) - 1)] += 1
        total: Any = 0
        for digit in range(1 << _DIGIT_BITS):
            size = ends[digit]
            ends[digit] = total
            total += size
        for i in ids:
            bucket = (np.int64(keys[i]) >> shift) & ((1 << _DIGIT_BITS) - 1)
            other[ends[bucket]] = i
            ends[bucket] += 1
        ids, other = other, ids
    return ids


@compiled
def _measure(begin: int, end: int, ids: Any, splats: Any, region: Any, table: Any, boxes: Any, counts: Any) -> None:
    """Write a rank's row of the table and its rectangle of tiles in a region, and at rank + 1 its number of columns."""
    means2d, covars2d, conics, radii, opacities = splats
    number = table.dtype.type
    per_bin = BIN // TILE
    for rank in range(begin, end):
        i = ids[rank]
        radius = number(radii[i])
        finite = abs(float(means2d[i, 0]) + means2d[i, 1] + conics[i, 0] + conics[i, 1] + conics[i, 2]) < np.inf
        reach = number(log(opacities[i] / number(MIN_ALPHA))) + number(ROUNDING)
        for axis in range(2):
            centre = means2d[i, axis]
            half = number(sqrt(number(2) * reach * covars2d[i, 2 * axis]))
            low = max(np.floor((centre - radius) / BIN) * per_bin, np.floor((centre - half) / TILE))
            high = min(np.ceil((centre + radius) / BIN) * per_bin, np.ceil((centre + half) / TILE))
            boxes[rank, axis] = np.int32(min(max(low, region[axis]), region[2 + axis]))
            boxes[rank, 2 + axis] = np.int32(min(max(high, region[axis]), region[2 + axis]))
            table[rank, HALF_WIDTH + axis] = half
        table[rank, U], table[rank, V] = means2d[i, 0], means2d[i, 1]
        table[rank, HALF_XX], table[rank, HALF_YY] = number(0.5) * conics[i, 0], number(0.5) * conics[i, 2]
        table[rank, XY] = conics[i, 1]
        table[rank, OPACITY], table[rank, LIMIT] = opacities[i], reach
        if not finite:
            boxes[rank] = 0
        counts[rank + 1] = max(boxes[rank, 2] - boxes[rank, 0], 0)


@compiled
def _find_intervals(
    begin: int, end: int, table: Any, boxes: Any, first_intervals: Any, intervals: Any, counts: Any
) -> None:
    """Write the pixel rows that a rank touches in each column of tiles, and at rank + 1 the number of tiles."""
    for rank in range(begin, end):
        first_row, end_row = boxes[rank, 1] * TILE, boxes[rank, 3] * TILE
        tiles = 0
        for column in range(boxes[rank, 0], boxes[rank, 2]):
            low, high = _touched_rows(table, rank, column * TILE)
            # A NaN, from footprints that overflow, gives the whole column.
            first = np.int64(min(np.ceil(low), end_row)) if low > first_row else first_row
            beyond = np.int64(max(np.floor(high) + 1, first_row)) if high < end_row - 1 else end_row
            interval = first_intervals[rank] + column - boxes[rank, 0]
            intervals[interval, 0], intervals[interval, 1] = first, beyond
            tiles += _num_tiles(first, beyond)
        counts[rank + 1] = tiles


@compiled
def _num_tiles(first: int, beyond: int) -> int:
    """Number of tiles with pixel rows from ``first`` to ``beyond``, excluded."""
    return (beyond - 1) // TILE - first // TILE + 1 if beyond > first else 0


@compiled
def _touched_rows(table: Any, rank: int, left: int) -> tuple[float, float]:
    """The lowest and highest position, in pixel rows, of exponents that are blended within a column of tiles."""
    # They fill an ellipse, from slope dx - rise to slope dx + rise at dx from its centre. If its topmost point is
    # outside the column, the highest position is on the nearer edge of the column; the lowest is symmetric.
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
def _sort_by_tile(boxes: Any, first_intervals: Any, intervals: Any, columns: int, rows: int) -> tuple[Any, Any, Any]:
    """Starts of the lists, and in list order (by tile, then by rank) the ranks and touched steps."""
    starts: Any = np.zeros(columns * rows + 1, np.int64)
    for rank in range(len(first_intervals) - 1):
        for interval in range(first_intervals[rank], first_intervals[rank + 1]):
            column = boxes[rank, 0] + interval - first_intervals[rank]
            row = intervals[interval, 0] // TILE
            for _ in range(_num_tiles(intervals[interval, 0], intervals[interval, 1])):
                starts[row * columns + column + 1] += 1
                row += 1
    for tile in range(columns * rows):
        starts[tile + 1] += starts[tile]
    ranks, spans = np.empty(starts[-1], np.int32), np.empty((starts[-1], 2), np.uint8)
    ends: Any = starts.copy()
    for rank in range(len(first_intervals) - 1):
        for interval in range(first_intervals[rank], first_intervals[rank + 1]):
            first, beyond = intervals[interval, 0], intervals[interval, 1]
            column = boxes[rank, 0] + interval - first_intervals[rank]
            row = first // TILE
            for _ in range(_num_tiles(first, beyond)):
                tile = row * columns + column
                entry = ends[tile]
                ranks[entry] = rank
                spans[entry, 0] = max(first - row * TILE, 0) // STEP
                spans[entry, 1] = (min(beyond - row * TILE, TILE) + STEP - 1) // STEP
                ends[tile] += 1
                row += 1
    return starts, ranks, spans
