"""Which photos are compared: all pairs, neighbours in time, or those that look alike."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Matching = Literal["auto", "exhaustive", "sequential", "similar"]
MOST_EXHAUSTIVE = 200
"""Number of photos up to which all pairs are compared: 19,900 pairs."""
_NEIGHBOURS = 10
"""Frames of a video that each is compared with; further ones at distances that double."""
_LOOPS = 5
"""Most similar frames that are farther away, which close a loop."""
_ALIKE = 40
"""Most similar photos that each is compared with."""
_BESIDE = 3
"""Photos after each, in the order of their names, that it is compared with too."""
_WORDS = 64
_SAMPLED = 20_000
_ROUNDS = 10
_BLOCK = 20
"""Photos of a block of pairs; COLMAP loads the features of two blocks at a time."""

Pairs = list[tuple[int, int]]


def chosen(matching: Matching, count: int, video: bool) -> Matching:
    """The way to compare photos that ``auto`` stands for."""
    if matching != "auto":
        return matching
    return "sequential" if video else "exhaustive" if count <= MOST_EXHAUSTIVE else "similar"


def exhaustive(count: int) -> Pairs:
    """All pairs ``(i, j)``, ``i < j``."""
    return in_blocks(combinations(range(count), 2))


def sequential(similarity: NDArray[np.float32]) -> Pairs:
    """Each frame with its neighbours in time, and with similar ones from when the camera comes back.

    Args:
        similarity: of all frames ``[N, N]``, from :func:`similarities`.
    """
    count = len(similarity)
    apart = [*range(1, _NEIGHBOURS + 1)]
    while apart[-1] * 2 < count:
        apart.append(apart[-1] * 2)
    pairs = {(i, i + step) for step in apart for i in range(count - step)}
    far = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) > 2 * _NEIGHBOURS
    return in_blocks(pairs | _most_similar(np.where(far, similarity, -np.inf), _LOOPS))


def similar(similarity: NDArray[np.float32]) -> Pairs:
    """Each photo with those that look most like it, and with the next ones by name."""
    count = len(similarity)
    pairs = {(i, i + step) for step in range(1, _BESIDE + 1) for i in range(count - step)}
    return in_blocks(pairs | _most_similar(np.where(np.eye(count, dtype=bool), -np.inf, similarity), _ALIKE))


def _most_similar(similarity: NDArray[np.float32], count: int) -> set[tuple[int, int]]:
    """For each row, the columns of its ``count`` largest finite entries."""
    order = np.argsort(-similarity, axis=1, kind="stable")[:, :count]
    return {
        (min(i, int(j)), max(i, int(j)))
        for i, columns in enumerate(order)
        for j in columns
        if np.isfinite(similarity[i, j])
    }


def in_blocks(pairs: Iterable[tuple[int, int]]) -> Pairs:
    """Pairs in an order in which neighbours share photos."""
    return sorted(pairs, key=lambda pair: (pair[0] // _BLOCK, pair[1] // _BLOCK, pair))


def similarities(descriptors: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """How alike photos look, from -1 to 1 ``[N, N]``: cosines of their aggregated local descriptors (VLAD).

    The residuals of a photo's descriptors to the nearest of some visual words are summed for each word, and their
    signed square roots normalised. The words are those of these photos, so that nothing has to be downloaded.

    Args:
        descriptors: local features of each photo, ``[M_i, D]``; a photo may have none.

    References:
        Jégou, Douze, Schmid, Pérez: Aggregating local descriptors into a compact image representation. CVPR 2010.
    """
    words = _visual_words(descriptors)
    if not len(words):
        return np.zeros((len(descriptors), len(descriptors)), np.float32)
    summed = np.zeros((len(descriptors), *words.shape), np.float32)
    for photo, stored in zip(summed, descriptors, strict=True):
        rows = _unit(stored)
        if len(rows):
            nearest = _nearest(rows, words)
            np.add.at(photo, nearest, rows - words[nearest])
    flat = _unit(summed).reshape(len(summed), -1)  # a repeated pattern counts once
    flat = _unit(np.sign(flat) * np.sqrt(np.abs(flat)))
    return flat @ flat.T


def _unit(rows: NDArray[Any]) -> NDArray[np.float32]:
    """Rows along the last axis at length 1; those of length 0 stay."""
    rows = rows.astype(np.float32)
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-6)


def _visual_words(descriptors: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """Centres of k-means ``[K, D]`` of a sample of all descriptors; none if there are no descriptors."""
    generator, each = np.random.default_rng(0), max(1, _SAMPLED // len(descriptors))
    sample = [one[generator.permutation(len(one))[:each]] for one in descriptors if len(one)]
    if not sample:
        return np.zeros((0, 1), np.float32)
    rows = _unit(np.concatenate(sample))
    if len(rows) <= _WORDS:
        return rows
    words = rows[generator.choice(len(rows), _WORDS, replace=False)]
    for _ in range(_ROUNDS):
        nearest = _nearest(rows, words)
        sums, counts = np.zeros_like(words), np.bincount(nearest, minlength=_WORDS)
        np.add.at(sums, nearest, rows)
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words).astype(np.float32)
    return words


def _nearest(rows: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.intp]:
    """Index of the nearest word of each row ``[M]``."""
    return np.argmin((words**2).sum(axis=1) - 2 * rows @ words.T, axis=1)
