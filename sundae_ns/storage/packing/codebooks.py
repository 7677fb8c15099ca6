"""Residual codebooks: each vector is a sum of entries, one from each of a few small books, fitted by k-means.

Book 1 is fitted to the vectors, each further book to the residuals of the previous ones (Juang and Gray, 1982). A row
takes one byte per book.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.storage.packing.container import Encoded, Floats

MAX_ENTRIES = 256
"""Maximum number of entries of a book: one byte indexes them."""
ROWS_PER_ENTRY = 16
"""Minimum number of rows per entry; in smaller fields, books of 256 entries take more bytes than they save."""
EXACT = 0.001
"""Fraction of rows stored exactly: those with the largest error. It bounds the error of all others."""
_SAMPLE = 1 << 16  # rows of a k-means
_ROUNDS = 8  # Lloyd iterations
_CHUNK = 1 << 14  # rows compared with all centres at once


@dataclass(frozen=True, eq=False)
class Books:
    """Codec of vectors ``[N, D]`` by S books of K entries; see :func:`fit`."""

    entries: Tensor
    """In steps, int8 ``[S, K, D]``."""
    steps: Tensor
    """float32 ``[S]``."""
    rows: Tensor
    """Indices of the rows stored exactly, ascending ``[E]``."""

    def encode(self, values: Floats) -> Encoded:
        """Code vectors; ``bound`` is the largest error of an element."""
        indices = self.assign(torch.from_numpy(np.ascontiguousarray(values)))
        rows = self.rows.numpy()
        found = self.sums(indices).numpy()
        found[rows] = values[rows]
        bound = float(np.abs(values.astype(np.float64) - found).max(initial=0.0))
        return {"codec": "codebooks", "width": values.shape[1], "bound": bound}, {
            "indices": indices.numpy(),
            "entries": self.entries.numpy().reshape(len(self.entries), -1),
            "steps": self.steps.numpy(),
            "rows": rows.astype(np.uint32),
            "exact": values[rows],
        }

    def rounded(self, values: Tensor) -> Tensor:
        """Return the vectors that a reader decodes; bit for bit on a CPU, up to rounding elsewhere."""
        return self.sums(self.assign(values)).index_copy(0, self.rows, values[self.rows])

    def assign(self, vectors: Tensor) -> Tensor:
        """Index of an entry of each book for each vector, uint8 ``[S, N]``, chosen greedily."""
        residual = vectors.double().clone()
        tables = self.entries.float() * self.steps[:, None, None]
        return torch.stack([_subtract_nearest(residual, table) for table in tables]).to(torch.uint8)

    def sums(self, indices: Tensor) -> Tensor:
        """Vectors ``[N, D]`` of entry indices ``[S, N]``."""
        count, entries, width = self.entries.shape
        table = (self.entries.float() * self.steps[:, None, None]).reshape(-1, width)
        rows = indices.T.int() + torch.arange(0, count * entries, entries, dtype=torch.int32, device=indices.device)
        # embedding_bag sums table rows in one pass, on several threads.
        return F.embedding_bag(rows, table, mode="sum")


def fit(vectors: Floats, books: int, *, seed: int = 0) -> Books:
    """Fit books to finite vectors ``[N, D]``, N and D at least 1; ``seed`` is that of samples and initial centres."""
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
    error = (target - fitted.sums(indices)).abs().amax(dim=1)
    return replace(fitted, rows=error.topk(int(n * EXACT)).indices.sort().values)


def restore(
    indices: NDArray[np.uint8], entries: NDArray[np.int8], steps: Floats, rows: NDArray[np.uint32], exact: Floats
) -> Floats:
    """Vectors ``[N, D]`` from the arrays of :meth:`Books.encode`, with entries ``[S, K, D]``."""
    places = rows.astype(np.int64)
    books = Books(torch.from_numpy(entries.copy()), torch.from_numpy(steps.copy()), torch.from_numpy(places))
    out: Floats = books.sums(torch.from_numpy(indices.copy())).numpy()
    out[places] = exact
    return out


def _subtract_nearest(residual: Tensor, entries: Tensor) -> Tensor:
    """Index ``[N]`` of the nearest entry of one book; subtracts the entries from ``residual`` in place."""
    nearest = nearest_centre(residual, entries.double())
    residual -= entries.double()[nearest]
    return nearest


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
