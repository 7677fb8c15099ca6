"""Residual codebooks: a vector as a sum of entries, one of each of a few small books found by k-means.

Book 1 is fitted to the vectors, each further book to what the ones before it leave (Juang and Gray, 1982). A row is then as
many bytes as there are books.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

MOST_ENTRIES = 256
"""Entries of a book: what one byte can name."""
ROWS_AN_ENTRY = 16
"""Fields with fewer rows for each entry get smaller books, which would else take more bytes than they save."""
EXACT = 0.001
"""Share of rows, those that the books fit worst, that are stored as they are; it bounds the error of all others."""
_SAMPLE = 1 << 16  # rows that books are found by
_ROUNDS = 8  # of Lloyd's
_CHUNK = 1 << 14  # rows that are compared with all centres at once


class Codebooks(NamedTuple):
    """Vectors ``[N, D]`` by books; no element of a row is off by more than ``bound``."""

    indices: NDArray[np.uint8]
    """Entry of each book for each row ``[S, N]``."""
    entries: NDArray[np.int8]
    """Entries of the books, in steps ``[S, K, D]``."""
    steps: NDArray[np.float32]
    """Size of a step, one a book ``[S]``."""
    rows: NDArray[np.uint32]
    """Rows that are stored exactly, rising ``[E]``."""
    exact: NDArray[np.float32]
    """These rows ``[E, D]``."""
    bound: float


class Books(NamedTuple):
    """Books without the rows that they were fitted to."""

    entries: Tensor
    """In steps, int8 ``[S, K, D]``."""
    steps: Tensor
    """float32 ``[S]``."""
    rows: Tensor
    """Rows that are stored exactly, rising ``[E]``."""


def books_of(packed: Codebooks) -> Books:
    """The books that rows were packed with."""
    return Books(*(torch.from_numpy(x) for x in (packed.entries, packed.steps, packed.rows.astype(np.int64))))


def fit(vectors: NDArray[np.float32], books: int, *, seed: int = 0) -> Codebooks:
    """Find books, and the entries of each row.

    Args:
        vectors: ``[N, D]``, finite, N and D at least 1.
        books: how many, at least 1.
        seed: of the sample and the first centres.
    """
    n, width = vectors.shape
    entries = min(MOST_ENTRIES, max(1, n // ROWS_AN_ENTRY))
    generator = torch.Generator().manual_seed(seed)
    target = torch.from_numpy(np.ascontiguousarray(vectors)).double()
    rest = target.clone()
    kept = torch.zeros(books, entries, width, dtype=torch.int8)
    steps = torch.zeros(books)
    indices = torch.zeros(books, n, dtype=torch.uint8)
    for book in range(books):
        centres = kmeans(rest, entries, generator)
        step = (centres.abs().max() / 127).float()
        steps[book] = step
        if step > 0:
            kept[book] = (centres / step.double()).round().clamp(-127, 127).to(torch.int8)
        # What is left is taken from the entries as they are stored, so that the next book mends their rounding too.
        indices[book] = _take(rest, kept[book].float() * step).to(torch.uint8)
    books_alone = Books(kept, steps, torch.zeros(0, dtype=torch.int64))
    error = (target - _sums(indices, books_alone)).abs().amax(dim=1)
    worst = error.topk(int(n * EXACT)).indices.sort().values
    return _packed(vectors, indices, books_alone._replace(rows=worst))


def encode(vectors: NDArray[np.float32], books: Books) -> Codebooks:
    """Entries of vectors ``[N, D]`` in given books; the rows of ``books.rows`` are kept exactly."""
    return _packed(vectors, _pick(torch.from_numpy(np.ascontiguousarray(vectors)), books), books)


def rounded(vectors: Tensor, books: Books) -> Tensor:
    """What :func:`restore` makes of :func:`encode`: ``[N, D]``; to the bit on a CPU, in float32 elsewhere."""
    return _sums(_pick(vectors, books), books).index_copy(0, books.rows, vectors[books.rows])


def _packed(vectors: NDArray[np.float32], indices: Tensor, books: Books) -> Codebooks:
    rows = books.rows.numpy()
    made = Codebooks(
        indices.numpy(), books.entries.numpy(), books.steps.numpy(), rows.astype(np.uint32), vectors[rows], 0.0
    )
    return made._replace(bound=float(np.abs(vectors.astype(np.float64) - restore(made)).max(initial=0.0)))


def _take(rest: Tensor, stored: Tensor) -> Tensor:
    """Nearest entry of one book ``[N]``; it is taken off ``rest``."""
    nearest = nearest_centre(rest, stored.double())
    rest -= stored.double()[nearest]
    return nearest


def _pick(vectors: Tensor, books: Books) -> Tensor:
    """Entry of each book for each vector ``[S, N]``, one book after the other."""
    rest = vectors.double().clone()
    tables = books.entries.float() * books.steps[:, None, None]
    return torch.stack([_take(rest, table) for table in tables]).to(torch.uint8)


def _sums(indices: Tensor, books: Books) -> Tensor:
    """Vectors ``[N, D]`` of entries ``[S, N]``."""
    count, entries, width = books.entries.shape
    table = (books.entries.float() * books.steps[:, None, None]).reshape(-1, width)
    names = indices.T.int() + torch.arange(0, count * entries, entries, dtype=torch.int32, device=indices.device)
    # The sum of a few rows of a table: torch does it in one pass, on several threads.
    return F.embedding_bag(names, table, mode="sum")


def restore(packed: Codebooks) -> NDArray[np.float32]:
    """Counterpart of :func:`encode`: ``[N, D]``."""
    indices, entries, steps = (torch.from_numpy(x.copy()) for x in (packed.indices, packed.entries, packed.steps))
    out: NDArray[np.float32] = _sums(indices, Books(entries, steps, torch.zeros(0, dtype=torch.int64))).numpy()
    out[packed.rows] = packed.exact
    return out


def kmeans(rows: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Centres ``[count, D]`` by Lloyd's rounds on a sample of the rows."""
    sample = rows[torch.randperm(len(rows), generator=generator)[:_SAMPLE]]
    centres = sample[:count].clone()
    for _ in range(_ROUNDS):
        nearest = nearest_centre(sample, centres)
        number = torch.bincount(nearest, minlength=count)[:, None]
        sums = torch.zeros_like(centres).index_add_(0, nearest, sample)
        centres = torch.where(number > 0, sums / number.clamp_min(1), centres)
    return centres


def nearest_centre(rows: Tensor, centres: Tensor) -> Tensor:
    """Index ``[N]`` of the nearest centre of each row."""
    # |x - c|^2 less |x|^2, in float32: a wrong pick between two like entries costs nothing.
    flat, half = centres.float(), (centres * centres).sum(dim=1).float() / 2
    return torch.cat([(chunk.float() @ flat.T - half).argmax(dim=1) for chunk in rows.split(_CHUNK)])
