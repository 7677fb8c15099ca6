"""Residual codebooks: each vector is a sum of entries, one from each of a few small books, fitted by k-means.

Book 1 is fitted to the vectors, each further book to the residuals of the previous ones (Juang and Gray, 1982). A row
takes one byte per book.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

MAX_ENTRIES = 256
"""Maximum number of entries of a book: one byte indexes them."""
ROWS_PER_ENTRY = 16
"""Minimum number of rows per entry; in smaller fields, books of 256 entries take more bytes than they save."""
EXACT = 0.001
"""Fraction of rows stored exactly: those with the largest error. It bounds the error of all others."""
_SAMPLE = 1 << 16  # rows of a k-means
_ROUNDS = 8  # Lloyd iterations
_CHUNK = 1 << 14  # rows compared with all centres at once


class Codebooks(NamedTuple):
    """Vectors ``[N, D]`` coded by S books of K entries; the error of each element is at most ``bound``."""

    indices: NDArray[np.uint8]
    """Entry of each book for each row ``[S, N]``."""
    entries: NDArray[np.int8]
    """Entries of the books, in steps ``[S, K, D]``."""
    steps: NDArray[np.float32]
    """Step of each book ``[S]``."""
    rows: NDArray[np.uint32]
    """Indices of the rows stored exactly, ascending ``[E]``."""
    exact: NDArray[np.float32]
    """These rows ``[E, D]``."""
    bound: float


class Books(NamedTuple):
    """Books without the indices of the vectors."""

    entries: Tensor
    """In steps, int8 ``[S, K, D]``."""
    steps: Tensor
    """float32 ``[S]``."""
    rows: Tensor
    """Indices of the rows stored exactly, ascending ``[E]``."""


def books_of(packed: Codebooks) -> Books:
    """The books of packed vectors."""
    return Books(*(torch.from_numpy(x) for x in (packed.entries, packed.steps, packed.rows.astype(np.int64))))


def fit(vectors: NDArray[np.float32], books: int, *, seed: int = 0) -> Codebooks:
    """Fit books to vectors, and code the vectors.

    Args:
        vectors: ``[N, D]``, finite, N and D at least 1.
        books: number of books, at least 1.
        seed: seed of the samples and the initial centres.
    """
    n, width = vectors.shape
    entries = min(MAX_ENTRIES, max(1, n // ROWS_PER_ENTRY))
    generator = torch.Generator().manual_seed(seed)
    target = torch.from_numpy(np.ascontiguousarray(vectors)).double()
    residual = target.clone()
    kept = torch.zeros(books, entries, width, dtype=torch.int8)
    steps = torch.zeros(books)
    indices = torch.zeros(books, n, dtype=torch.uint8)
    for book in range(books):
        centres = kmeans(residual, entries, generator)
        step = (centres.abs().max() / 127).float()
        steps[book] = step
        if step > 0:
            kept[book] = (centres / step.double()).round().clamp(-127, 127).to(torch.int8)
        # Subtract the entries as stored, so that the next book also corrects their rounding.
        indices[book] = _subtract_nearest(residual, kept[book].float() * step).to(torch.uint8)
    fitted = Books(kept, steps, torch.zeros(0, dtype=torch.int64))
    error = (target - _sums(indices, fitted)).abs().amax(dim=1)
    worst = error.topk(int(n * EXACT)).indices.sort().values
    return _packed(vectors, indices, fitted._replace(rows=worst))


def encode(vectors: NDArray[np.float32], books: Books) -> Codebooks:
    """Code vectors ``[N, D]`` with given books; ``books.rows`` are stored exactly."""
    return _packed(vectors, _assign(torch.from_numpy(np.ascontiguousarray(vectors)), books), books)


def rounded(vectors: Tensor, books: Books) -> Tensor:
    """The result ``[N, D]`` of :func:`encode` and :func:`restore`; bit for bit on a CPU, up to rounding elsewhere."""
    return _sums(_assign(vectors, books), books).index_copy(0, books.rows, vectors[books.rows])


def _packed(vectors: NDArray[np.float32], indices: Tensor, books: Books) -> Codebooks:
    rows = books.rows.numpy()
    packed = Codebooks(
        indices.numpy(), books.entries.numpy(), books.steps.numpy(), rows.astype(np.uint32), vectors[rows], 0.0
    )
    return packed._replace(bound=float(np.abs(vectors.astype(np.float64) - restore(packed)).max(initial=0.0)))


def _subtract_nearest(residual: Tensor, entries: Tensor) -> Tensor:
    """Index ``[N]`` of the nearest entry of one book; subtracts the entries from ``residual`` in place."""
    nearest = nearest_centre(residual, entries.double())
    residual -= entries.double()[nearest]
    return nearest


def _assign(vectors: Tensor, books: Books) -> Tensor:
    """Index of an entry of each book for each vector ``[S, N]``, chosen greedily."""
    residual = vectors.double().clone()
    tables = books.entries.float() * books.steps[:, None, None]
    return torch.stack([_subtract_nearest(residual, table) for table in tables]).to(torch.uint8)


def _sums(indices: Tensor, books: Books) -> Tensor:
    """Vectors ``[N, D]`` of entry indices ``[S, N]``."""
    count, entries, width = books.entries.shape
    table = (books.entries.float() * books.steps[:, None, None]).reshape(-1, width)
    rows = indices.T.int() + torch.arange(0, count * entries, entries, dtype=torch.int32, device=indices.device)
    # embedding_bag sums table rows in one pass, on several threads.
    return F.embedding_bag(rows, table, mode="sum")


def restore(packed: Codebooks) -> NDArray[np.float32]:
    """Vectors ``[N, D]`` of the result of :func:`encode`."""
    indices, entries, steps = (torch.from_numpy(x.copy()) for x in (packed.indices, packed.entries, packed.steps))
    out: NDArray[np.float32] = _sums(indices, Books(entries, steps, torch.zeros(0, dtype=torch.int64))).numpy()
    out[packed.rows] = packed.exact
    return out


def kmeans(rows: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Centres ``[count, D]`` by Lloyd iterations on a sample of the rows."""
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
    # |x - c|^2 minus |x|^2, in float32: a wrong choice between nearly equal centres costs nothing.
    flat, half = centres.float(), (centres * centres).sum(dim=1).float() / 2
    return torch.cat([(chunk.float() @ flat.T - half).argmax(dim=1) for chunk in rows.split(_CHUNK)])
