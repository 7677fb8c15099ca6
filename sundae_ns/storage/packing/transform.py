"""Transform coding: rows become uncorrelated coefficients (Karhunen-Loeve), which are rounded to one step.

Many coefficients have little variance and round to zero, which the entropy coder stores in almost no bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.storage.packing.container import Array, Encoded, Floats

EXACT = 0.001
"""Fraction of rows that may exceed one byte per coefficient; they are stored exactly."""
_UNIT = 127
_CHUNK = 1 << 16


@dataclass(frozen=True, eq=False)
class Transform:
    """Codec of rows ``[N, D]``; see :func:`fit`."""

    basis: Tensor
    """Change of a row per step of each coefficient, in 127ths of the step, int8 ``[D, D]``."""
    inverse: Tensor
    """Matrix from rows to coefficients, float64 ``[D, D]``."""
    step: float
    limit: int
    """Rows with a larger coefficient, in steps, are stored exactly."""

    @property
    def bound(self) -> float:
        """Maximum error of an element, without float32 rounding: that of each coefficient is at most half a step."""
        columns = self.basis.T.contiguous().numpy().astype(np.float64) / _UNIT
        return float(self.step / 2 * np.abs(columns).sum(axis=1).max())

    def encode(self, values: Floats) -> Encoded:
        """Transform and round finite rows."""
        levels, kept = self.levels(torch.from_numpy(values))
        rows = np.flatnonzero(kept.numpy())
        return {"codec": "transform", "step": self.step, "bound": self.bound}, {
            "codes": levels.T.numpy().astype(np.int8 if self.limit < 128 else np.int16, order="C"),
            "basis": self.basis.numpy().reshape(-1),
            "rows": rows.astype(np.uint32),
            "exact": values[rows],
        }

    def rounded(self, values: Tensor) -> Tensor:
        """Return the rows that a reader decodes; bit for bit on a CPU, up to rounding elsewhere."""
        levels, exact = self.levels(values)
        return torch.where(exact[:, None], values, _expand(levels.T.contiguous(), self.basis, self.step))

    def levels(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Coefficients in whole steps, float64 ``[N, D]``, and a mask ``[N]`` of rows stored exactly."""
        levels = (rows.double() @ self.inverse / self.step).round()
        exact = levels.abs().amax(dim=1) > self.limit
        return levels.masked_fill(exact[:, None], 0.0), exact


def fit(rows: Floats, step: float) -> Transform:
    """Fit a transform with a positive step to finite rows ``[N, D]``, N and D at least 1."""
    values = rows.astype(np.float64)
    # Divide rows by the square root of their length, so that a few huge rows do not dominate the basis.
    weight = 1 / np.sqrt(np.maximum(np.linalg.norm(values, axis=1, keepdims=True), step))
    shrunk = values * weight
    axes = np.linalg.eigh(shrunk.T @ shrunk)[1][:, ::-1].T
    basis = np.rint(axes * _UNIT).astype(np.int8)
    # Invert the stored basis, so that its rounding adds no error.
    inverse = torch.from_numpy(np.linalg.inv(basis / _UNIT))
    # In the order of a file: products of other layouts round differently.
    stored = torch.from_numpy(np.ascontiguousarray(basis))
    wide = Transform(stored, inverse, step, int(np.iinfo(np.int16).max))
    small = int(np.iinfo(np.int8).max)
    largest = wide.levels(torch.from_numpy(rows))[0].abs().amax(dim=1)
    return replace(wide, limit=small) if float((largest > small).double().mean()) <= EXACT else wide


def restore(codes: Array, basis: NDArray[np.int8], step: float, rows: NDArray[np.uint32], exact: Floats) -> Floats:
    """Rows ``[N, D]`` from the arrays of :meth:`Transform.encode`, with a basis ``[D, D]``."""
    out: Floats = _expand(torch.from_numpy(codes), torch.from_numpy(basis.astype(np.float32)), step).numpy()
    out[rows] = exact
    return out


def _expand(codes: Tensor, basis: Tensor, step: float) -> Tensor:
    """Rows ``[N, D]``, float32, of coefficients in steps ``[D, N]``, for a basis in 127ths of the step ``[D, D]``."""
    width, n = codes.shape
    out = torch.empty(n, width, device=codes.device)
    scaled = basis.float() * float(np.float32(step / _UNIT))
    for start in range(0, n, _CHUNK):
        torch.mm(codes[:, start : start + _CHUNK].float().T, scaled, out=out[start : start + _CHUNK])
    return out
