"""Transform coding: rows become uncorrelated coefficients (Karhunen-Loeve), which are rounded to one step.

Many coefficients have little variance and round to zero, which the entropy coder stores in almost no bytes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

EXACT = 0.001
"""Fraction of rows that may exceed one byte per coefficient; they are stored exactly."""
_UNIT = 127
_CHUNK = 1 << 16


class Transformed(NamedTuple):
    """Rows ``[N, D]``; see :func:`bound`."""

    codes: NDArray[Any]
    """Coefficients in steps, int8 or int16 ``[D, N]``."""
    basis: NDArray[np.int8]
    """Change of a row per step of each coefficient, in 127ths of the step ``[D, D]``."""
    step: float
    rows: NDArray[np.uint32]
    """Indices of the rows stored exactly, ascending ``[E]``."""
    exact: NDArray[np.float32]
    """These rows ``[E, D]``."""


class Basis(NamedTuple):
    """Transform and step of rows; see :func:`fit_basis`."""

    basis: Tensor
    """Change of a row per step of each coefficient, in 127ths of the step, int8 ``[D, D]``."""
    inverse: Tensor
    """Matrix from rows to coefficients, float64 ``[D, D]``."""
    step: float
    limit: int
    """Rows with a larger coefficient, in steps, are stored exactly."""


def bound(packed: Transformed) -> float:
    """Maximum error of an element, without float32 rounding: that of each coefficient is at most half a step."""
    return float(packed.step / 2 * np.abs(packed.basis.astype(np.float64) / _UNIT).sum(axis=0).max())


def fit_basis(rows: NDArray[np.float32], step: float) -> Basis:
    """Fit a basis to rows.

    Args:
        rows: ``[N, D]``, finite, N and D at least 1.
        step: in the unit of the rows, positive.
    """
    values = rows.astype(np.float64)
    # Divide rows by the square root of their length, so that a few huge rows do not dominate the basis.
    weight = 1 / np.sqrt(np.maximum(np.linalg.norm(values, axis=1, keepdims=True), step))
    shrunk = values * weight
    axes = np.linalg.eigh(shrunk.T @ shrunk)[1][:, ::-1].T
    basis = np.rint(axes * _UNIT).astype(np.int8)
    # Invert the stored basis, so that its rounding adds no error.
    inverse = torch.from_numpy(np.linalg.inv(basis / _UNIT))
    wide = Basis(torch.from_numpy(basis), inverse, step, int(np.iinfo(np.int16).max))
    small = int(np.iinfo(np.int8).max)
    largest = coefficients(torch.from_numpy(rows), wide)[0].abs().amax(dim=1)
    return wide._replace(limit=small) if float((largest > small).double().mean()) <= EXACT else wide


def coefficients(rows: Tensor, basis: Basis) -> tuple[Tensor, Tensor]:
    """Coefficients of rows ``[N, D]`` in whole steps, float64 ``[N, D]``, and a mask ``[N]`` of rows stored exactly."""
    levels = (rows.double() @ basis.inverse / basis.step).round()
    exact = levels.abs().amax(dim=1) > basis.limit
    return levels.masked_fill(exact[:, None], 0.0), exact


def expand(codes: Tensor, basis: Tensor, step: float) -> Tensor:
    """Rows ``[N, D]``, float32, of coefficients in steps ``[D, N]``, for a basis in 127ths of the step ``[D, D]``."""
    width, n = codes.shape
    out = torch.empty(n, width, device=codes.device)
    scaled = basis.float() * float(np.float32(step / _UNIT))
    for start in range(0, n, _CHUNK):
        torch.mm(codes[:, start : start + _CHUNK].float().T, scaled, out=out[start : start + _CHUNK])
    return out


def rounded(rows: Tensor, basis: Basis) -> Tensor:
    """The result ``[N, D]`` of :func:`forward` and :func:`backward`; bit for bit on a CPU, up to rounding elsewhere."""
    levels, exact = coefficients(rows, basis)
    return torch.where(exact[:, None], rows, expand(levels.T.contiguous(), basis.basis, basis.step))


def forward(rows: NDArray[np.float32], basis: Basis) -> Transformed:
    """Transform and round finite rows ``[N, D]``."""
    levels, kept = coefficients(torch.from_numpy(rows), basis)
    exact = np.flatnonzero(kept.numpy())
    codes = levels.T.numpy().astype(np.int8 if basis.limit < 128 else np.int16, order="C")
    return Transformed(codes, basis.basis.numpy(), basis.step, exact.astype(np.uint32), rows[exact])


def backward(packed: Transformed) -> NDArray[np.float32]:
    """Rows ``[N, D]`` of the result of :func:`forward`."""
    basis = torch.from_numpy(packed.basis.astype(np.float32))
    array: NDArray[np.float32] = expand(torch.from_numpy(packed.codes), basis, packed.step).numpy()
    array[packed.rows] = packed.exact
    return array
