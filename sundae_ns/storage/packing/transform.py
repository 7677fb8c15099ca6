"""Transform coding: rows turned into uncorrelated coefficients (Karhunen-Loeve), these rounded to one step.

Many coefficients then have little variance and round to zero, which the entropy coder makes next to nothing of.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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


class Basis(NamedTuple):
    """How rows are turned and rounded; see :func:`fit_basis`."""

    basis: Tensor
    """What a step of each coefficient adds to a row, in 127ths of the step, int8 ``[D, D]``."""
    inverse: Tensor
    """Coefficients of rows, in units of the rows, float64 ``[D, D]``."""
    step: float
    limit: int
    """Rows with a larger coefficient, in steps, are kept exactly."""


def bound(packed: Transformed) -> float:
    """Most that an element is off, but for rounding in float32: each coefficient is off by at most half a step."""
    return float(packed.step / 2 * np.abs(packed.basis.astype(np.float64) / _UNIT).sum(axis=0).max())


def fit_basis(rows: NDArray[np.float32], step: float) -> Basis:
    """Find the basis of rows like these.

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
    inverse = torch.from_numpy(np.linalg.inv(basis / _UNIT))
    made = Basis(torch.from_numpy(basis), inverse, step, int(np.iinfo(np.int16).max))
    small = int(np.iinfo(np.int8).max)
    largest = coefficients(torch.from_numpy(rows), made)[0].abs().amax(dim=1)
    return made._replace(limit=small) if float((largest > small).double().mean()) <= EXACT else made


def coefficients(rows: Tensor, basis: Basis) -> tuple[Tensor, Tensor]:
    """Coefficients of rows ``[N, D]`` in whole steps, float64 ``[N, D]``, and which rows are kept exactly ``[N]``."""
    found = (rows.double() @ basis.inverse / basis.step).round()
    exact = found.abs().amax(dim=1) > basis.limit
    return found.masked_fill(exact[:, None], 0.0), exact


def expand(codes: Tensor, basis: Tensor, step: float) -> Tensor:
    """Rows ``[N, D]``, float32, of coefficients in steps ``[D, N]`` by a basis in 127ths ``[D, D]``."""
    width, n = codes.shape
    out = torch.empty(n, width, device=codes.device)
    scaled = basis.float() * float(np.float32(step / _UNIT))
    for start in range(0, n, _CHUNK):
        torch.mm(codes[:, start : start + _CHUNK].float().T, scaled, out=out[start : start + _CHUNK])
    return out


def rounded(rows: Tensor, basis: Basis) -> Tensor:
    """What :func:`backward` makes of :func:`forward`: ``[N, D]``; to the bit on a CPU, in float32 elsewhere."""
    found, exact = coefficients(rows, basis)
    return torch.where(exact[:, None], rows, expand(found.T.contiguous(), basis.basis, basis.step))


def forward(rows: NDArray[np.float32], basis: Basis) -> Transformed:
    """Turn and round rows ``[N, D]``, finite."""
    found, kept = coefficients(torch.from_numpy(rows), basis)
    exact = np.flatnonzero(kept.numpy())
    codes = found.T.numpy().astype(np.int8 if basis.limit < 128 else np.int16, order="C")
    return Transformed(codes, basis.basis.numpy(), basis.step, exact.astype(np.uint32), rows[exact])


def backward(packed: Transformed) -> NDArray[np.float32]:
    """Counterpart of :func:`forward`: ``[N, D]``."""
    basis = torch.from_numpy(packed.basis.astype(np.float32))
    array: NDArray[np.float32] = expand(torch.from_numpy(packed.codes), basis, packed.step).numpy()
    array[packed.rows] = packed.exact
    return array
