"""Transform coding: rows turned into uncorrelated coefficients (Karhunen-Loeve), these rounded to one step.

Many coefficients then have little variance and round to zero, which the entropy coder makes next to nothing of.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

EXACT = 0.001
"""Share of rows that may need larger numbers than one byte holds and are then stored as they are."""
_UNIT = 127
_CHUNK = 1 << 16


class Transformed(NamedTuple):
    """Rows ``[N, D]``; see :func:`bound`."""

    codes: NDArray[Any]
    """Coefficients in steps, int8 or int16 ``[D, N]``."""
    basis: NDArray[np.int8]
    """What a step of each coefficient adds to a row, in 127ths of the step ``[D, D]``."""
    step: float
    rows: NDArray[np.uint32]
    """Rows that are stored exactly, rising ``[E]``."""
    exact: NDArray[np.float32]
    """These rows ``[E, D]``."""


def bound(packed: Transformed) -> float:
    """Most that an element is off, but for rounding in float32: each coefficient is off by at most half a step."""
    return float(packed.step / 2 * np.abs(packed.basis.astype(np.float64) / _UNIT).sum(axis=0).max())


def forward(rows: NDArray[np.float32], step: float) -> Transformed:
    """Turn and round rows.

    Args:
        rows: ``[N, D]``, finite, N and D at least 1.
        step: in the unit of the rows, positive.
    """
    values = rows.astype(np.float64)
    # Over the square roots of the rows' lengths, so that a few huge rows do not turn the basis towards themselves.
    weight = 1 / np.sqrt(np.maximum(np.linalg.norm(values, axis=1, keepdims=True), step))
    shrunk = values * weight
    axes = np.linalg.eigh(shrunk.T @ shrunk)[1][:, ::-1].T
    basis = np.rint(axes * _UNIT).astype(np.int8)
    # The coefficients of the basis as it is stored, so that its rounding costs nothing.
    levels = np.rint(values @ np.linalg.inv(basis / _UNIT) / step)
    largest = np.abs(levels).max(axis=1)
    dtype = np.int8 if (largest > np.iinfo(np.int8).max).mean() <= EXACT else np.int16
    exact = np.flatnonzero(largest > np.iinfo(dtype).max)
    levels[exact] = 0
    codes = np.ascontiguousarray(levels.T.astype(dtype))
    return Transformed(codes, basis, step, exact.astype(np.uint32), rows[exact])


def backward(packed: Transformed) -> NDArray[np.float32]:
    """Counterpart of :func:`forward`: ``[N, D]``."""
    width, n = packed.codes.shape
    out = torch.empty(n, width)
    basis = torch.from_numpy(packed.basis.astype(np.float32) * np.float32(packed.step / _UNIT))
    codes = torch.from_numpy(packed.codes)
    for start in range(0, n, _CHUNK):
        torch.mm(codes[:, start : start + _CHUNK].float().T, basis, out=out[start : start + _CHUNK])
    array: NDArray[np.float32] = out.numpy()
    array[packed.rows] = packed.exact
    return array
