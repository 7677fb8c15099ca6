"""The search on the CPU: scipy's k-d tree over the distinct positions, with ties settled by index.

A k-d tree cannot part points at one position: a search among a million clones would look at all of them for each. So
clones are grouped first, the tree is built and searched once a position, and groups are written out afterwards.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy.spatial import cKDTree

from sundae_ns.graphs.threads import for_each, slices

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]

CHUNK_ELEMENTS = 2**17
"""Most candidates of a thread at a time: 2 MiB of indices and distances, which stay in the cache."""

ASKED_AGAIN = 4
"""So many times as many neighbours show where a tie ends, but for those of a point that is very far away."""

HASHED = 2**15
"""Points that a thread hashes at a time."""

ROUNDING = 4 * np.finfo(np.float64).eps
"""Distances closer than this, relatively, may be the same or swapped: the tree's own sums may be rounded otherwise."""


class _Positions(NamedTuple):
    """The distinct positions of a field and the points at each."""

    coordinates: Floats
    """Distinct positions, float64 ``[U, 3]``."""
    members: Ints
    """Points by position, and by rising index at one position ``[N]``."""
    starts: Ints
    """Where each position's points begin among the members ``[U]``."""
    counts: Ints
    """How many points are at each position ``[U]``."""
    singles: int
    """So many positions, the first ones, are known to have one point."""


def nearest(coordinates: Floats, k: int, limit: float, dtype: DTypeLike) -> tuple[Ints, Floats]:
    """The ``k`` nearest neighbours of every point, ordered by squared distance and then by index.

    Squared distances are ``(dx dx + dy dy) + dz dz`` in float64, each step rounded: to the bit those of the search on a
    GPU.

    Args:
        coordinates: finite positions, float64, at least one ``[N, 3]``.
        k: number of neighbours.
        limit: squared distances of neighbours are strictly below this, squared scene units; ``inf`` for no limit.
        dtype: of the distances that are returned.

    Returns:
        Indices and distances ``[N, k]``; own index and ``inf`` where a neighbour is missing.
    """
    n = len(coordinates)
    indices = np.empty((n, k), np.int64)
    distances = np.empty((n, k), dtype)
    width = min(k, n - 1)
    indices[:, width:] = np.arange(n)[:, None]
    distances[:, width:] = np.inf
    positions = _distinct(coordinates)
    first = positions.members[positions.starts]
    # Boxes that are fitted to their points take a quarter of the time to build, and save nothing in a balanced tree.
    tree = cKDTree(positions.coordinates, compact_nodes=False)

    def search(rows: Ints) -> None:
        # One more than needed shows whether the last one taken ties with the first one left out.
        found, lengths = _query(tree, rows, k + 2)
        if positions.singles == n:
            # Nothing else lies where a point lies, so it is the first of its own neighbours; and no position has moved, as
            # those do that only look like clones.
            indices[rows, :width] = found[:, 1 : k + 1]
            distances[rows, :width] = lengths[:, 1 : k + 1]
        else:
            crowded = (found >= positions.singles).any(axis=1)
            if not crowded.all():
                own = first[rows[~crowded]]
                indices[own, :width] = first[found[~crowded, 1 : k + 1]]
                distances[own, :width] = lengths[~crowded, 1 : k + 1]
            if crowded.any():
                members = _members(positions, found[crowded], lengths[crowded], k + 1)
                _write(indices, distances, positions, rows[crowded], *members)
        tied = (lengths[:, 1:] <= lengths[:, :-1] * (1 + ROUNDING)).any(axis=1)
        for settled in _settled(positions, tree, rows[tied], found[tied], lengths[tied], k + 1):
            _write(indices, distances, positions, *settled)

    # Queries that follow each other down the tree find it in the cache; in the order of a field they mostly do not.
    for_each(search, _parts(tree.indices, k + 2))
    if limit < np.inf:
        for_each(lambda rows: _drop_far(coordinates, indices, distances, limit, rows), _parts(np.arange(n), k))
    return indices, distances


def _distinct(coordinates: Floats) -> _Positions:
    """Group coincident points, by a 64-bit hash of their coordinates: sorting it is far cheaper than sorting those.

    Few points have clones as a rule. One sort finds those that may: of words with the index in their lowest bits and as much of
    the hash as there is room for above.
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
    """Points by position, and by rising index at one; where each position begins among them, and how many points it has."""
    members = np.argsort(hashes, kind="stable")
    equal = (coordinates[members[1:]] == coordinates[members[:-1]]).all(axis=1)
    if (hashes[members[1:]] == hashes[members[:-1]]).sum() != equal.sum():
        # Two positions share a hash, and their points may be mixed up.
        members = np.lexsort(coordinates.T)
        equal = (coordinates[members[1:]] == coordinates[members[:-1]]).all(axis=1)
    starts = np.flatnonzero(np.append(True, ~equal)[: len(members)])
    return members, starts, np.diff(np.append(starts, len(members)))


def _hash(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix three words a row into one, by odd multipliers and shifts; ``[N, 3]`` to ``[N]``."""
    mixed = np.zeros(len(bits), np.uint64)
    for axis in range(3):
        mixed = (mixed ^ bits[:, axis]) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(32)
    return mixed


def _query(tree: cKDTree, rows: Ints, asked: int) -> tuple[Ints, Floats]:
    """The nearest positions of the positions ``rows``, nearest first, or all where there are not so many."""
    lengths, found = tree.query(tree.data[rows], k=np.arange(1, min(asked, tree.n) + 1))
    return found, lengths


def _members(positions: _Positions, found: Ints, lengths: Floats, width: int) -> tuple[Ints, Floats]:
    """Write positions out as the points at them: the first ``width`` of each row, or all N where there are not so many."""
    counts = positions.counts[found]
    room = width - (np.cumsum(counts, axis=1) - counts)
    slots, points = _written_out(positions, found, np.clip(room, 0, counts))
    return points.reshape(len(found), -1), lengths.ravel()[slots].reshape(len(found), -1)


def _write(indices: Ints, distances: Floats, positions: _Positions, rows: Ints, points: Ints, lengths: Floats) -> None:
    """Give every point at the positions ``rows`` the points of its row, without itself.

    A point is absent from its own row where that is filled by clones of lower index; then the last one goes.
    """
    row, own = _written_out(positions, rows, positions.counts[rows])
    width = points.shape[1] - 1
    # Cut up once more, for all points of the field may lie at one position.
    for part in _parts(np.arange(len(row)), width + 1):
        others = points[row[part]] != own[part, None]
        others[:, -1] &= ~others.all(axis=1)
        indices[own[part], :width] = points[row[part]][others].reshape(-1, width)
        distances[own[part], :width] = lengths[row[part]][others].reshape(-1, width)


def _settled(
    positions: _Positions, tree: cKDTree, rows: Ints, found: Ints, lengths: Floats, width: int
) -> Iterator[tuple[Ints, Ints, Floats]]:
    """For positions with ties, by squared distance and index: rows, and the first ``width`` points of each.

    The last neighbour that was found has to lie clearly behind the last one needed; where it does not, the tree is asked for
    more. Seen from very far away a whole field is one tie in float64: then all positions are looked at, because the tree
    would do so each time that it is asked.
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
    """What lies no farther may be needed ``[R, 1]``."""
    return lengths[:, min(width, lengths.shape[1]) - 1, None] * (1 + ROUNDING)


def _is_settled(tree: cKDTree, found: Ints, lengths: Floats, width: int) -> NDArray[np.bool_]:
    """Whether all that can be among the first ``width`` has been found ``[R]``."""
    return (lengths[:, -1:] > _last_needed(lengths, width)).ravel() | (found.shape[1] == tree.n)


def _nearest_of(
    positions: _Positions, rows: Ints, found: Ints, lengths: Floats, width: int
) -> Iterator[tuple[Ints, Ints, Floats]]:
    """In parts, the first ``width`` points of those at the positions found."""
    if not len(rows):
        return
    taken = np.where(lengths <= _last_needed(lengths, width), np.minimum(positions.counts[found], width), 0)
    for part in _parts(np.arange(len(rows)), int(taken.sum(axis=1).max())):
        yield rows[part], *_sorted_members(positions, rows[part], found[part], taken[part], width)


def _nearest_of_all(positions: _Positions, rows: Ints, width: int) -> tuple[Ints, Floats]:
    """The first ``width`` points of all, as :func:`_sorted_members` has them, a row at a time."""
    wanted, last = min(width, len(positions.members)), min(width, len(positions.coordinates)) - 1
    points, lengths = np.empty((len(rows), wanted), np.int64), np.empty((len(rows), wanted))
    for place, row in enumerate(rows):
        x, y, z = (positions.coordinates - positions.coordinates[row]).T
        squared = x * x + y * y + z * z
        limit = np.partition(squared, last)[last]
        near, tied = np.flatnonzero(squared < limit), np.flatnonzero(squared == limit)
        if len(tied) > wanted:
            # Points come by rising index at each position: none but the first positions have one of the first points.
            tied = tied[np.argpartition(positions.members[positions.starts[tied]], wanted - 1)[:wanted]]
        near = np.concatenate([near, tied])
        taken = np.minimum(positions.counts[near], width)
        _, found = _written_out(positions, near, taken)
        distances = np.repeat(squared[near], taken)
        first = np.lexsort((found, distances))[:wanted]
        points[place], lengths[place] = found[first], np.sqrt(distances[first])
    return points, lengths


def _sorted_members(positions: _Positions, rows: Ints, found: Ints, taken: Ints, width: int) -> tuple[Ints, Floats]:
    """The first ``width`` points by squared distance and index.

    Args:
        positions: positions and points.
        rows: the positions that the search was for ``[R]``.
        found: positions near them ``[R, C]``.
        taken: how many points of those to look at ``[R, C]``; 0 for what is too far ``[R, C]``.
        width: number of points wanted; all N where there are not so many.
    """
    x, y, z = np.moveaxis(positions.coordinates[found] - positions.coordinates[rows, None], 2, 0)
    squared = x * x + y * y + z * z
    totals = taken.sum(axis=1)
    slots, points = _written_out(positions, found, taken)
    room = np.arange(totals.max()) < totals[:, None]
    distances = np.full(room.shape, np.inf)
    distances[room] = squared.ravel()[slots]
    indices = np.zeros(room.shape, np.int64)
    indices[room] = points
    order = np.argsort(distances, axis=1, kind="stable")
    distances = np.take_along_axis(distances, order, axis=1)
    # Number the runs of equal distances: then one key sorts by distance and index.
    runs = np.zeros(room.shape, np.int64)
    np.cumsum(distances[:, 1:] != distances[:, :-1], axis=1, out=runs[:, 1:])
    runs *= len(positions.members)
    keys = np.sort(runs + np.take_along_axis(indices, order, axis=1), axis=1)
    wanted = min(width, len(positions.members))
    return (keys - runs)[:, :wanted], np.sqrt(distances[:, :wanted])


def _written_out(positions: _Positions, found: Ints, taken: Ints) -> tuple[Ints, Ints]:
    """The first ``taken`` points at each position found, in one row after the other, and which position each is from."""
    flat = taken.ravel()
    slots = np.repeat(np.arange(flat.size), flat)
    offsets = np.arange(len(slots)) - np.repeat(np.cumsum(flat) - flat, flat)
    return slots, positions.members[positions.starts[found.ravel()[slots]] + offsets]


def _parts(rows: Ints, columns: int) -> list[Ints]:
    """Rows in parts of not many more than :data:`CHUNK_ELEMENTS` elements."""
    return np.array_split(rows, min(len(rows), -(-len(rows) * columns // CHUNK_ELEMENTS))) if len(rows) else []


def _drop_far(coordinates: Floats, indices: Ints, distances: Floats, limit: float, rows: Ints) -> None:
    """Put the own index and ``inf`` in place of neighbours of the points ``rows`` that are not within the limit."""
    x, y, z = np.moveaxis(coordinates[indices[rows]] - coordinates[rows, None], 2, 0)
    far = ~(x * x + y * y + z * z < limit)
    indices[rows] = np.where(far, rows[:, None], indices[rows])
    distances[rows] = np.where(far, np.inf, distances[rows])
