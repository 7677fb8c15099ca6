"""Transform coding: rows become uncorrelated coefficients (Karhunen-Loeve), which are rounded to one step.

Many coefficients have little variance and round to zero, which the entropy coder stores in almost no bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.storage.packing.container import Coded, Floats, Levels
from sundae_ns.storage.packing.entropy import LARGEST

_UNIT = 127
_CHUNK = 1 << 16
_LEAST = 0.02
"""Smallest eigenvalue of a form, as a share of the mean: other views see more of these errors."""


@dataclass(frozen=True, eq=False)
class Transform:
    """Codec of rows ``[N, D]``; see :func:`fit`."""

    mean: Tensor
    """The row whose coefficients are all 0, float32 ``[D]``."""
    basis: Tensor
    """Change of a row per step of each coefficient, in 127ths of the step, int8 ``[D, D]``."""
    inverse: Tensor
    """Matrix from rows to coefficients, float64 ``[D, D]``."""
    step: float

    @property
    def bound(self) -> float:
        """Maximum error of an element, without float32 rounding: that of each coefficient is at most half a step."""
        columns = self.basis.T.contiguous().numpy().astype(np.float64) / _UNIT
        return float(self.step / 2 * np.abs(columns).sum(axis=1).max())

    def encode(self, values: Floats) -> Coded:
        """Transform and round finite rows."""
        about = {"codec": "transform", "width": values.shape[1], "step": self.step, "bound": self.bound}
        levels = self._levels(torch.from_numpy(values)).numpy().astype(np.int32)
        return about, levels, {"mean": self.mean.numpy(), "basis": self.basis.numpy().reshape(-1)}

    def rounded(self, values: Tensor) -> Tensor:
        """Return the rows that a reader decodes; bit for bit on a CPU, up to rounding elsewhere."""
        return _expand(self._levels(values), self.mean, self.basis, self.step)

    def coefficients(self, rows: Tensor) -> Tensor:
        """Coefficients in steps, float64 ``[N, D]``; gradients flow through them."""
        return (rows.double() - self.mean.double()) @ self.inverse / self.step

    def with_step(self, step: float, rows: Floats) -> Transform:
        """The same basis with another step, or a larger one where the largest coefficient of rows would not fit."""
        other = replace(self, step=step)
        highest = float(other.coefficients(torch.from_numpy(rows)).abs().max())
        return replace(self, step=step * max(2 * highest / LARGEST, 1.0))

    def _levels(self, rows: Tensor) -> Tensor:
        return self.coefficients(rows).round().clamp(-LARGEST, LARGEST)


def fit(rows: Floats, step: float, *, centred: bool = True, form: Tensor | None = None) -> Transform:
    """Fit a transform to finite rows ``[N, D]``, N and D at least 1.

    Args:
        rows: the values.
        step: positive; a larger one is used where the largest coefficient would not fit.
        centred: subtract the mean row; else rows of zeros stay exact.
        form: weighs errors e of rows by e' form e, positive definite ``[D, D]``; coefficients are uncorrelated where
            this is the squared length. None or zeros for the identity.
    """
    values = rows.astype(np.float64)
    mean = (values.mean(axis=0) if centred else np.zeros(rows.shape[1])).astype(np.float32)
    values = values - mean
    root, back = _roots(rows.shape[1], form)
    values = values @ root
    # Divide rows by the square root of their length, so that a few huge rows do not dominate the basis.
    shrunk = values / np.sqrt(np.maximum(np.linalg.norm(values, axis=1, keepdims=True), step))
    axes = np.linalg.eigh(shrunk.T @ shrunk)[1][:, ::-1].T @ back
    largest = float(np.abs(axes).max()) if form is not None else 1.0
    # In the order of a file: products of other layouts round differently.
    basis = np.ascontiguousarray(np.rint(axes / largest * _UNIT).astype(np.int8))
    # Invert the stored basis, so that its rounding adds no error.
    inverse = torch.from_numpy(np.linalg.inv(basis / _UNIT))
    fitted = Transform(torch.from_numpy(mean), torch.from_numpy(basis), inverse, step * largest)
    return fitted.with_step(fitted.step, rows)


def _roots(size: int, form: Tensor | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The symmetric root ``[D, D]`` of a form, scaled to a mean eigenvalue of 1, and its inverse."""
    mean = 0.0 if form is None else form.trace().item() / size
    if form is None or mean <= 0:  # a head whose last layer is still zero sees no feature
        return np.eye(size), np.eye(size)
    values, vectors = np.linalg.eigh(form.numpy() / mean)
    roots = np.sqrt(np.maximum(values, _LEAST))
    return vectors * roots @ vectors.T, vectors / roots @ vectors.T


def rows_at(levels: Levels, mean: Floats, basis: NDArray[np.int8], step: float) -> Floats:
    """Rows ``[N, D]`` from levels ``[N, D]`` and the arrays of :meth:`Transform.encode`, with a basis ``[D, D]``."""
    # Copies, because arrays of a file are read-only.
    return _expand(torch.tensor(levels), torch.tensor(mean), torch.tensor(basis), step).numpy()


def _expand(levels: Tensor, mean: Tensor, basis: Tensor, step: float) -> Tensor:
    """Rows ``[N, D]``, float32, of levels ``[N, D]``, for a basis in 127ths of the step ``[D, D]``."""
    out = torch.empty(levels.shape, device=levels.device)
    scaled = basis.float() * float(np.float32(step / _UNIT))
    for start in range(0, len(levels), _CHUNK):
        torch.addmm(mean, levels[start : start + _CHUNK].float(), scaled, out=out[start : start + _CHUNK])
    return out
