"""Quantisation: positions in blocks, rotations near the identity, rows by a transform, weights of the head.

A transform (Karhunen-Loeve) makes rows uncorrelated; most coefficients round to zero, which takes almost no bytes.
Error bounds do not count the rounding of the result to float32. Rounding is implemented once, in torch: files store
levels, and training with rounding uses the values of the same levels.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.io.coordinates import interleave, separate
from sundae_ns.io.pack.container import Coded, Floats, Levels
from sundae_ns.io.pack.entropy import LARGEST

_UNIT = 127  # a basis is stored in these parts of a step
_CHUNK = 1 << 16  # rows expanded at once
_LEAST_EIGENVALUE = 0.02  # of a form, relative to the mean: other cameras see more of these errors


class Blocks(NamedTuple):
    """Positions in blocks of neighbours; per block and axis, the error is at most (high - low) / (2^bits - 1) / 2.

    ``codes`` ``[N]`` are Morton codes of cells, ascending in each block; ``low`` and ``high`` its bounds ``[B, 3]``.
    """

    codes: NDArray[np.uint64]
    low: Floats
    high: Floats

    @property
    def cells(self) -> NDArray[np.uint64]:
        """Cells ``[N, 3]`` of the blocks' grids."""
        return np.stack([separate(self.codes, axis) for axis in range(3)], axis=1)


def quantize_positions(means: Floats, bits: int, size: int) -> tuple[Blocks, NDArray[np.int64]]:
    """Round positions to a grid in each block, and sort each block by Morton code, so that differences are small.

    ``means`` ``[N, 3]`` are finite, in the order of ``coordinates.scene_order``; a coordinate of a cell has ``bits``, a
    block ``size`` Gaussians. Returns the blocks, and the permutation ``[N]`` from their order to rows of ``means``.
    """
    n = len(means)
    starts = np.arange(0, n, size)
    low, high = np.minimum.reduceat(means, starts), np.maximum.reduceat(means, starts)
    block = np.arange(n) // size
    extent = high.astype(np.float64) - low
    extent[extent == 0] = 1.0
    cells = np.rint((means.astype(np.float64) - low[block]) / extent[block] * (2**bits - 1)).astype(np.uint64)
    codes = interleave(cells)
    order = np.lexsort((codes, block))
    return Blocks(codes[order], low, high), order


def dequantize_positions(packed: Blocks, bits: int, size: int) -> Floats:
    """Positions ``[N, 3]`` of the result of :func:`quantize_positions`, in the order of the blocks."""
    block = np.arange(len(packed.codes)) // size
    step = (packed.high.astype(np.float64) - packed.low) / (2**bits - 1)
    return (packed.cells * step[block] + packed.low[block]).astype(np.float32)


def aligned(quats: Floats, scales: Floats) -> tuple[Floats, Floats]:
    """Turn the axes of ellipsoids so that their rotations are as small as possible; the ellipsoids are the same.

    An ellipsoid has 24 descriptions: its axes in another order, or reversed. The one with the smallest rotation has
    w of at least 0.85, so that three components tell the fourth, and takes 4.6 bits less.
    ``quats`` ``[N, 4]`` are wxyz, finite, of any length, zero ones the identity; ``scales`` ``[N, 3]`` are one for each
    axis. Returns unit quaternions with w positive, and the scales in their new order.
    """
    # The 24 rotations of a cube; of a quaternion and its negative, the one whose first nonzero component is positive.
    candidates = [q for q in itertools.product((1, 0, -1), repeat=4) if np.count_nonzero(q) in (1, 2, 4)]
    turns = np.array([q for q in candidates if q > (0, 0, 0, 0)], np.float64)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    w, x, y, z = torch.from_numpy(quats).double().T.numpy()
    products = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    best = np.abs(np.einsum("cn,gc->gn", products[0], turns)).argmax(axis=0)
    turned = np.einsum("rcn,nc->nr", products, turns[best])
    turned = _normalized(torch.from_numpy(turned)).numpy()
    # A turn puts the axis in which it has a column's 1 into that column's place.
    places = rotation_matrices(torch.from_numpy(turns)).abs().numpy().argmax(axis=1)
    return turned.astype(np.float32), np.take_along_axis(scales, places[best], axis=1)


@dataclass(frozen=True, eq=False)
class Rotations:
    """Codec of quaternions ``[N, 4]`` wxyz by x, y and z; see :func:`rotation_bound`."""

    step: float

    def encode(self, values: Floats) -> Coded:
        """Quantise finite quaternions of any length; zero ones are the identity, as in the rasterisers."""
        about = {"codec": "xyz", "width": 3, "step": self.step, "bound": rotation_bound(self.step)}
        return about, self.coefficients(torch.from_numpy(values)).round().numpy().astype(np.int32), {}

    def rounded(self, values: Tensor) -> Tensor:
        """Return the unit quaternions that a reader decodes; bit for bit on a CPU."""
        return rotations_at(self.coefficients(values).round(), self.step)

    def coefficients(self, values: Tensor) -> Tensor:
        """Components x, y and z in steps, float64 ``[N, 3]``; gradients flow through them."""
        return _normalized(values.double())[:, 1:] / self.step


def rotations_at(levels: Tensor, step: float) -> Tensor:
    """Unit quaternions wxyz ``[N, 4]``, float32, of levels of x, y and z ``[N, 3]``; w is positive."""
    x, y, z = (levels.double() * step).float().T
    # Written out: a reduction could round differently for another number of rows.
    square = x * x + y * y + z * z
    w = (1 - square).clamp_min(0).sqrt()
    length = (w * w + square).sqrt()
    return torch.stack([part / length for part in (w, x, y, z)], dim=1)


def rotation_bound(step: float) -> float:
    """Maximum error of the angle of an aligned rotation, radians.

    The vector v of x, y and z has an error of at most sqrt(3) / 2 steps. On the sphere of unit quaternions, a step of v
    is stretched by at most 1 / w, and w is sqrt(1 - |v|^2). Aligned rotations turn by at most 62.8 degrees, so |v| is
    at most 0.522 before rounding. The angle of a rotation is twice the angle on that sphere.
    """
    off = 3**0.5 * step / 2
    return 2 * off / (1 - min(0.522 + off, 0.999) ** 2) ** 0.5


def _normalized(quats: Tensor) -> Tensor:
    """Unit quaternions ``[N, 4]``, float64, with w at least 0; zero ones become the identity."""
    scale = quats.abs().amax(dim=1, keepdim=True)
    # No tensor of numbers: it would be copied to the device, which no CUDA graph can record.
    w, x, y, z = (quats / torch.where(scale > 0, scale, 1.0)).T
    w = torch.where(scale[:, 0] > 0, w, 1.0)
    length = (w * w + x * x + y * y + z * z).sqrt() * torch.where(w < 0, -1.0, 1.0)
    return torch.stack([part / length for part in (w, x, y, z)], dim=1)


@dataclass(frozen=True, eq=False)
class Transform:
    """Codec of rows ``[N, D]``; see :func:`fit_transform`.

    ``mean`` ``[D]``, float32, is the row whose coefficients are all 0; ``basis`` ``[D, D]``, int8, the change of a row
    per step of each coefficient, in 127ths of the step; ``inverse`` ``[D, D]``, float64, maps rows to coefficients.
    """

    mean: Tensor
    basis: Tensor
    inverse: Tensor
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


def fit_transform(rows: Floats, step: float, *, centred: bool = True, form: Tensor | None = None) -> Transform:
    """Fit a transform to finite rows ``[N, D]``, N and D at least 1.

    A larger ``step`` is used where the largest coefficient would not fit. Rows that are not ``centred`` on their mean
    keep zeros exact. ``form`` ``[D, D]``, positive definite, weighs errors e of rows by e' form e; coefficients are
    uncorrelated where this is the squared length. None or zeros stand for the identity.
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
    # Contiguous, as from a file: products of other layouts round differently.
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
    roots = np.sqrt(np.maximum(values, _LEAST_EIGENVALUE))
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


def weight_steps(weight: Tensor, share: float) -> Tensor:
    """Step of each output channel, float32 ``[O]``: a share of the largest weight of ``[O, ...]``."""
    return (weight.reshape(len(weight), -1).double().abs().amax(dim=1) * share).float()


def weight_levels(weight: Tensor, step: Tensor) -> Tensor:
    """Nearest levels of weights ``[O, I, ...]``, float64; the error is at most half of the channels' step."""
    return in_steps(weight, step).round().clamp(-LARGEST, LARGEST)


def in_steps(weight: Tensor, step: Tensor) -> Tensor:
    """Weights ``[O, I, ...]`` in steps ``[O, I]``, float64; gradients flow through them."""
    wide = step.reshape(*step.shape, *([1] * (weight.ndim - 2))).double()
    return weight.double() / torch.where(wide > 0, wide, 1.0)


def weights_at(levels: Tensor, step: Tensor) -> Tensor:
    """Weights ``[O, I, ...]``, float32, of levels of any dtype and steps ``[O, I]``."""
    return levels.float() * step.reshape(*step.shape, *([1] * (levels.ndim - 2)))
