"""Neighbour search on the CPU: scipy's k-d tree over the distinct positions, with ties broken by index.

A k-d tree cannot separate points at one position: among a million clones each search would visit all of them. So clones are
grouped first, the tree is built and searched once per position, and groups are expanded to their points afterwards.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sundae_ns.graphs.threads import for_each, slices

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]

CHUNK_ELEMENTS = 2**17
"""Most candidates of a thread at a time: 2 MiB of indices and distances, which fit into the cache."""

ASKED_AGAIN = 4
"""Factor of neighbours asked for in a second query, to find where a tie ends; points that are very far away need more."""

HASHED = 2**15
"""Number of points that a thread hashes at a time."""

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
    singles: int
    """Number of positions, at the start, that are known to have one point."""


def nearest(coordinates: Floats, k: int, dtype: DTypeLike) -> tuple[Ints, Floats]:
    """The ``k`` nearest neighbours of every point, ordered by squared distance and then by index.

    Squared distances are ``(dx dx + dy dy) + dz dz`` in float64, each step rounded, bit for bit as in the search on a GPU.

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
    first = positions.members[positions.starts]
    from scipy.spatial import cKDTree  # takes half a second, also in commands that search nothing

    # Fitting boxes to their points takes a quarter of the time to build, and saves nothing in a balanced tree.
    tree = cKDTree(positions.coordinates, compact_nodes=False)

    def search(rows: Ints) -> None:
        # One more neighbour than needed shows whether the last one ties with the first one left out.
        found, lengths = _query(tree, rows, k + 2)
        if positions.singles == n:
            # No clones: each point finds itself first, and positions keep the order of the points.
            indices[rows] = found[:, 1 : k + 1]
            distances[rows] = lengths[:, 1 : k + 1]
        else:
            crowded = (found >= positions.singles).any(axis=1)
            if not crowded.all():
                own = first[rows[~crowded]]
                indices[own] = first[found[~crowded, 1 : k + 1]]
                distances[own] = lengths[~crowded, 1 : k + 1]
            if crowded.any():
                members = _members(positions, found[crowded], lengths[crowded], k + 1)
                _write(indices, distances, positions, rows[crowded], *members)
        tied = (lengths[:, 1:] <= lengths[:, :-1] * (1 + ROUNDING)).any(axis=1)
        for settled in _without_ties(positions, tree, rows[tied], found[tied], lengths[tied], k + 1):
            _write(indices, distances, positions, *settled)

    # In the order of the tree, consecutive queries find their part of it in the cache; in the order of a field rarely.
    for_each(search, _parts(tree.indices, k + 2))
    return indices, distances


def _distinct(coordinates: Floats) -> _Positions:
    """Group coincident points by a 64-bit hash of their coordinates, which is much cheaper to sort than the coordinates.

    Usually few points have clones. One sort finds the points that may have some: of words with the index in the lowest bits and
    the upper bits of the hash above.
    """
    n = len(coordinates)
    hashes, keys = np.empty(n, np.uint64), np.empty(n, np.uint64)
    low = np.uint64(n.bit_length())

    def fill(part: slice) -> None:
        # Adding 0 turns -0 into 0: the two are equal and must hash alike.
        hashes[part] = _hash((coordinates[part] + 0.0).view(np.uint64))
        keys[part] = hashes[part] >> low << low
        keys[part] |= np.arange(part.start, part.stop, dtype=np.uint64)

    for_each(fill, slices(n, HASHED))
    keys.sort()
    alike = keys[1:] ^ keys[:-1] < np.uint64(1) << low
    suspects = np.flatnonzero(np.append(alike, False) | np.append(False, alike))
    candidates = np.sort((keys[suspects] & ((np.uint64(1) << low) - np.uint64(1))).astype(np.int64))
    alone = np.ones(n, bool)
    alone[candidates] = False
    singles = np.flatnonzero(alone)
    members, starts, counts = _grouped(coordinates[candidates], hashes[candidates])
    members = candidates[members]
    return _Positions(
        np.concatenate([coordinates[singles], coordinates[members[starts]]]) if len(members) else coordinates,
        np.concatenate([singles, members]),
        np.concatenate([np.arange(len(singles)), len(singles) + starts]),
        np.concatenate([np.ones(len(singles), np.int64), counts]),
        len(singles),
    )


def _grouped(coordinates: Floats, hashes: NDArray[np.uint64]) -> tuple[Ints, Ints, Ints]:
    """Points grouped by position, ascending within a group; start and size of each group."""
    members = np.argsort(hashes, kind="stable")
    equal = (coordinates[members[1:]] == coordinates[members[:-1]]).all(axis=1)
    if (hashes[members[1:]] == hashes[members[:-1]]).sum() != equal.sum():
        # Two positions share a hash, so their points may alternate: sort by coordinates.
        members = np.lexsort(coordinates.T)
        equal = (coordinates[members[1:]] == coordinates[members[:-1]]).all(axis=1)
    starts = np.flatnonzero(np.append(True, ~equal)[: len(members)])
    return members, starts, np.diff(np.append(starts, len(members)))


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


def _members(positions: _Positions, found: Ints, lengths: Floats, width: int) -> tuple[Ints, Floats]:
    """Expand positions to the points at them: the first ``width`` points of each row, all N if there are fewer."""
    counts = positions.counts[found]
    left = width - (np.cumsum(counts, axis=1) - counts)
    slots, points = _expand(positions, found, np.clip(left, 0, counts))
    return points.reshape(len(found), -1), lengths.ravel()[slots].reshape(len(found), -1)


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

    The last neighbour found must be clearly farther than the last one needed; otherwise the tree is asked for more. From
    very far away a whole field is one tie in float64. Then all positions are compared, as the tree would do in each query.
    """
    done = _is_settled(tree, found, lengths, width)
    yield from _nearest_of(positions, rows[done], found[done], lengths[done], width)
    asked = ASKED_AGAIN * found.shape[1]
    for part in _parts(rows[~done], asked):
        found, lengths = _query(tree, part, asked)
        done = _is_settled(tree, found, lengths, width)
        yield from _nearest_of(positions, part[done], found[done], lengths[done], width)
        if not done.all():
            yield part[~done], *_nearest_of_all(positions, part[~done], width)


def _last_needed(lengths: Floats, width: int) -> Floats:
    """Distance up to which a point may be among the first ``width`` ``[R, 1]``."""
    return lengths[:, min(width, lengths.shape[1]) - 1, None] * (1 + ROUNDING)


def _is_settled(tree: cKDTree, found: Ints, lengths: Floats, width: int) -> NDArray[np.bool_]:
    """Whether every point that can be among the first ``width`` has been found, bool ``[R]``."""
    return (lengths[:, -1:] > _last_needed(lengths, width)).ravel() | (found.shape[1] == tree.n)


def _nearest_of(
    positions: _Positions, rows: Ints, found: Ints, lengths: Floats, width: int
) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Yield, in parts, rows and the first ``width`` points among those at the found positions."""
    if not len(rows):
        return
    taken = np.where(lengths <= _last_needed(lengths, width), np.minimum(positions.counts[found], width), 0)
    for part in _parts(np.arange(len(rows)), int(taken.sum(axis=1).max())):
        yield rows[part], *_sorted_members(positions, rows[part], found[part], taken[part], width)


def _nearest_of_all(positions: _Positions, rows: Ints, width: int) -> tuple[Ints, Floats]:
    """The first ``width`` of all points for each row, ordered as by :func:`_sorted_members`; one row at a time."""
    wanted, last = min(width, len(positions.members)), min(width, len(positions.coordinates)) - 1
    points, lengths = np.empty((len(rows), wanted), np.int64), np.empty((len(rows), wanted))
    for place, row in enumerate(rows):
        x, y, z = (positions.coordinates - positions.coordinates[row]).T
        squared = x * x + y * y + z * z
        limit = np.partition(squared, last)[last]
        near, tied = np.flatnonzero(squared < limit), np.flatnonzero(squared == limit)
        if len(tied) > wanted:
            # Members ascend at each position, so only positions with the lowest first members can contribute.
            tied = tied[np.argpartition(positions.members[positions.starts[tied]], wanted - 1)[:wanted]]
        near = np.concatenate([near, tied])
        taken = np.minimum(positions.counts[near], width)
        _, found = _expand(positions, near, taken)
        distances = np.repeat(squared[near], taken)
        first = np.lexsort((found, distances))[:wanted]
        points[place], lengths[place] = found[first], np.sqrt(distances[first])
    return points, lengths


def _sorted_members(positions: _Positions, rows: Ints, found: Ints, taken: Ints, width: int) -> tuple[Ints, Floats]:
    """The first ``width`` points of each row by squared distance and index; all N if there are fewer.

    Args:
        positions: positions and points.
        rows: positions searched for ``[R]``.
        found: positions near them ``[R, C]``.
        taken: number of points to use at each of those, 0 for positions that are too far ``[R, C]``.
        width: number of points to return.
    """
    x, y, z = np.moveaxis(positions.coordinates[found] - positions.coordinates[rows, None], 2, 0)
    squared = x * x + y * y + z * z
    totals = taken.sum(axis=1)
    slots, points = _expand(positions, found, taken)
    used = np.arange(totals.max()) < totals[:, None]
    distances = np.full(used.shape, np.inf)
    distances[used] = squared.ravel()[slots]
    indices = np.zeros(used.shape, np.int64)
    indices[used] = points
    order = np.argsort(distances, axis=1, kind="stable")
    distances = np.take_along_axis(distances, order, axis=1)
    # Number the runs of equal distances, so that one key sorts by distance and index.
    runs = np.zeros(used.shape, np.int64)
    np.cumsum(distances[:, 1:] != distances[:, :-1], axis=1, out=runs[:, 1:])
    runs *= len(positions.members)
    keys = np.sort(runs + np.take_along_axis(indices, order, axis=1), axis=1)
    wanted = min(width, len(positions.members))
    return (keys - runs)[:, :wanted], np.sqrt(distances[:, :wanted])


def _expand(positions: _Positions, found: Ints, taken: Ints) -> tuple[Ints, Ints]:
    """Flat list of the first ``taken`` points at each found position: their slots in ``found``, and their indices."""
    flat = taken.ravel()
    slots = np.repeat(np.arange(flat.size), flat)
    offsets = np.arange(len(slots)) - np.repeat(np.cumsum(flat) - flat, flat)
    return slots, positions.members[positions.starts[found.ravel()[slots]] + offsets]


def _parts(rows: Ints, columns: int) -> list[Ints]:
    """Rows in parts of about :data:`CHUNK_ELEMENTS` elements at most."""
    return np.array_split(rows, min(len(rows), -(-len(rows) * columns // CHUNK_ELEMENTS))) if len(rows) else []
