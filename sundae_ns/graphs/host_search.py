"""Neighbour search on the CPU: scipy's k-d tree over the distinct positions, with ties broken by index.

A k-d tree cannot separate points at one position: among a million clones each search would visit all of them. So clones
are grouped first, the tree is built and searched once per position, and groups are expanded to their points afterwards.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]

CHUNK_ELEMENTS = 2**17
"""Most candidates of a thread at a time: 2 MiB of indices and distances, which fit into the cache."""

ASKED_AGAIN = 4
"""Factor of neighbours asked for in a second query, to find where a tie ends; points that are very far away need
more."""

ROUNDING = 4 * np.finfo(np.float64).eps
"""Relative difference below which distances may be equal or swapped: the tree rounds its own sums differently."""


class _Positions(NamedTuple):
    """The distinct positions of a field and the points at each."""

    coordinates: Floats
    """Distinct positions, float64 ``[U, 3]``."""
    members: Ints
    """Indices of points, grouped by position and ascending within a group ``[N]``."""
    starts: Ints
    """Start of each position's points in ``members`` ``[U]``."""
    counts: Ints
    """Number of points at each position ``[U]``."""


def nearest(coordinates: Floats, k: int, dtype: DTypeLike) -> tuple[Ints, Floats]:
    """The ``k`` nearest neighbours of every point, ordered by squared distance and then by index.

    Squared distances are ``(dx dx + dy dy) + dz dz`` in float64, each step rounded, bit for bit as on a GPU.

    Args:
        coordinates: finite positions, float64 ``[N, 3]``.
        k: number of neighbours, at least 1 and less than N.
        dtype: dtype of the returned distances.

    Returns:
        Indices and ascending distances ``[N, k]``.
    """
    n = len(coordinates)
    indices = np.empty((n, k), np.int64)
    distances = np.empty((n, k), dtype)
    positions = _distinct(coordinates)
    first, crowded = positions.members[positions.starts], positions.counts > 1
    from scipy.spatial import cKDTree  # takes half a second, also in commands that search nothing

    # Fitting boxes to their points takes a quarter of the time to build, and saves nothing in a balanced tree.
    tree = cKDTree(positions.coordinates, compact_nodes=False)

    def search(rows: Ints) -> None:
        # One more neighbour than needed shows whether the last one ties with the first one left out.
        found, lengths = _query(tree, rows, k + 2)
        tied = (lengths[:, 1:] <= lengths[:, :-1] * (1 + ROUNDING)).any(axis=1) | crowded[found].any(axis=1)
        own = first[rows[~tied]]
        if len(own):
            # Each point finds itself first.
            indices[own] = first[found[~tied, 1 : k + 1]]
            distances[own] = lengths[~tied, 1 : k + 1]
        for settled in _without_ties(positions, tree, rows[tied], found[tied], lengths[tied], k + 1):
            _write(indices, distances, positions, *settled)

    # In the order of the tree, consecutive queries find their part of it in the cache; in the order of a field rarely.
    parts, threads = _parts(tree.indices, k + 2), cores()
    if threads > 1 and len(parts) > 1:
        # numpy and scipy release the interpreter's lock while they compute.
        with ThreadPoolExecutor(min(threads, len(parts))) as pool:
            list(pool.map(search, parts))
    else:
        for part in parts:
            search(part)
    return indices, distances


def cores() -> int:
    """Number of cores that this process may use; follows ``taskset``, not ``OMP_NUM_THREADS``."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _distinct(coordinates: Floats) -> _Positions:
    """Group coincident points by a 64-bit hash of their coordinates, which is cheaper to sort than the coordinates."""
    n = len(coordinates)
    # Adding 0 turns -0 into 0: the two are equal and must hash alike.
    hashes = _hash((coordinates + 0.0).view(np.uint64))
    members = np.argsort(hashes, kind="stable")
    hashes = hashes[members]
    alike = hashes[1:] == hashes[:-1]
    if not alike.any():
        return _Positions(coordinates, np.arange(n), np.arange(n), np.ones(n, np.int64))
    equal = (coordinates[members[1:]] == coordinates[members[:-1]]).all(axis=1)
    if not np.array_equal(alike, equal):
        # Two positions share a hash, so their points may alternate: sort by coordinates.
        members = np.lexsort(coordinates.T)
        equal = (coordinates[members[1:]] == coordinates[members[:-1]]).all(axis=1)
    starts = np.flatnonzero(np.append(True, ~equal))
    return _Positions(coordinates[members[starts]], members, starts, np.diff(np.append(starts, n)))


def _hash(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix the three words of each row into one, by odd multipliers and shifts; ``[N, 3]`` to ``[N]``."""
    mixed = np.zeros(len(bits), np.uint64)
    for axis in range(3):
        mixed = (mixed ^ bits[:, axis]) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(32)
    return mixed


def _query(tree: cKDTree, rows: Ints, asked: int) -> tuple[Ints, Floats]:
    """The ``asked`` positions nearest to each position in ``rows``, nearest first; all of them if there are fewer."""
    lengths, found = tree.query(tree.data[rows], k=np.arange(1, min(asked, tree.n) + 1))
    return found, lengths


def _write(indices: Ints, distances: Floats, positions: _Positions, rows: Ints, points: Ints, lengths: Floats) -> None:
    """Write the neighbours of every point at the positions ``rows``: the points of its row without the point itself.

    If clones of lower index fill the row, the point is not in it; then the last entry is dropped.
    """
    row, own = _expand(positions, rows, positions.counts[rows])
    width = points.shape[1] - 1
    # In parts, because all points of the field may lie at one position.
    for part in _parts(np.arange(len(row)), width + 1):
        others = points[row[part]] != own[part, None]
        others[:, -1] &= ~others.all(axis=1)
        indices[own[part], :width] = points[row[part]][others].reshape(-1, width)
        distances[own[part], :width] = lengths[row[part]][others].reshape(-1, width)


def _without_ties(
    positions: _Positions, tree: cKDTree, rows: Ints, found: Ints, lengths: Floats, width: int
) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Break ties by squared distance and index: yields rows of positions, and the first ``width`` points of each.

    The last neighbour found must be clearly farther than the last one needed; otherwise the tree is asked for more.
    From very far away a whole field is one tie in float64. Then all positions are compared, as the tree would do.
    """
    columns = found.shape[1]
    # The column at which enough points are found, and the distance up to which a point may be among them.
    last = (np.cumsum(positions.counts[found], axis=1) < width).sum(axis=1, keepdims=True).clip(max=columns - 1)
    reach = np.take_along_axis(lengths, last, axis=1) * (1 + ROUNDING)
    done = (lengths[:, -1:] > reach).ravel() | (columns == tree.n)
    yield from _nearest_of(positions, rows[done], found[done], (lengths <= reach)[done], width)
    asked = ASKED_AGAIN * (width + 1)
    for part in _parts(rows[~done], asked):
        if columns < asked:
            yield from _without_ties(positions, tree, part, *_query(tree, part, asked), width)
        else:
            yield from _nearest_of_all(positions, part, width)


def _nearest_of_all(positions: _Positions, rows: Ints, width: int) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Yield, row by row, the first ``width`` of all points; as :func:`_nearest_of`."""
    last = min(width, len(positions.coordinates)) - 1
    for row in rows[:, None]:
        x, y, z = (positions.coordinates - positions.coordinates[row]).T
        squared = x * x + y * y + z * z
        near = np.flatnonzero(squared <= np.partition(squared, last)[last])[None]
        yield from _nearest_of(positions, row, near, np.ones_like(near, bool), width)


def _nearest_of(
    positions: _Positions, rows: Ints, found: Ints, near: NDArray[np.bool_], width: int
) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Yield, in parts, rows and their first ``width`` points by squared distance and index; all N if there are fewer.

    Args:
        positions: positions and points.
        rows: positions searched for ``[R]``.
        found: positions around them ``[R, C]``.
        near: whether points at these count ``[R, C]``.
        width: number of points to return.
    """
    taken = np.where(near, np.minimum(positions.counts[found], width), 0)
    totals = taken.sum(axis=1)
    for part in _parts(np.arange(len(rows)), int(totals.max(initial=0))):
        between = positions.coordinates[found[part]] - positions.coordinates[rows[part], None]
        x, y, z = np.moveaxis(between, 2, 0)
        slots, points = _expand(positions, found[part], taken[part])
        used = np.arange(totals[part].max()) < totals[part, None]
        squared = np.full(used.shape, np.inf)
        squared[used] = (x * x + y * y + z * z).ravel()[slots]
        indices = np.zeros(used.shape, np.int64)
        indices[used] = points
        order = np.lexsort((indices, squared))[:, :width]
        yield rows[part], np.take_along_axis(indices, order, 1), np.sqrt(np.take_along_axis(squared, order, 1))


def _expand(positions: _Positions, found: Ints, taken: Ints) -> tuple[Ints, Ints]:
    """Flat list of the first ``taken`` points at each found position: their slots in ``found``, and their indices."""
    flat = taken.ravel()
    slots = np.repeat(np.arange(flat.size), flat)
    offsets = np.arange(len(slots)) - np.repeat(np.cumsum(flat) - flat, flat)
    return slots, positions.members[positions.starts[found.ravel()[slots]] + offsets]


def _parts(rows: Ints, columns: int) -> list[Ints]:
    """Rows in parts of about :data:`CHUNK_ELEMENTS` elements at most."""
    return np.array_split(rows, min(len(rows), -(-len(rows) * columns // CHUNK_ELEMENTS))) if len(rows) else []
