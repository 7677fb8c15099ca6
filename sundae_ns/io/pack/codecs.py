"""Codecs of the attributes of a scene, fitted once, then used for writing and for training with rounding.

Positions are rounded in blocks, rotations near the identity, rows by a transform, weights of the head by channels. A
transform (Karhunen-Loeve) makes rows uncorrelated; most coefficients round to zero, which takes almost no bytes.
Error bounds do not count the rounding of the result to float32. Rounding is implemented once, in torch: files store
levels, and training with rounding uses the values of the same levels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.core.errors import PackError
from sundae_ns.core.gaussians import FEATURES, SPLAT_NAMES
from sundae_ns.io.coordinates import interleave, scene_order, separate
from sundae_ns.io.pack.config import STEPS, PackConfig
from sundae_ns.io.pack.container import Array, Coded, Floats
from sundae_ns.io.pack.entropy import LARGEST

_UNIT = 127  # a basis is stored in these parts of a step
_CHUNK, _PART = 1 << 16, 1 << 13  # rows expanded at once, and, as new memory takes a CPU long, transformed
_LEAST_EIGENVALUE = 0.02  # of a form, relative to the mean: other cameras see more of these errors
_LOGITS = (-6.0, 8.0)  # opacities outside look the same as at these: below 1/255 nothing is drawn
_STEPS = {  # options, by attribute
    "quats": "rotation_step",
    "scales": "scale_step",
    "opacities": "opacity_step",
    "features_dc": "color_step",
    "features_rest": "harmonics_step",
    FEATURES: "feature_step",
}
_LARGEST_SHARE = 0.5  # step of an output channel of the head, at most, relative to its largest weight
_RUN = 16  # neighbours on the curve whose levels share a mean and a magnitude, in the estimate of bits


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

    def positions(self, bits: int, size: int) -> Floats:
        """Positions ``[N, 3]`` of cells of ``bits`` a coordinate in blocks of this ``size``, in the blocks' order."""
        block = np.arange(len(self.codes)) // size
        step = (self.high.astype(np.float64) - self.low) / (2**bits - 1)
        return (self.cells * step[block] + self.low[block]).astype(np.float32)


def quantize_positions(means: Floats, bits: int, size: int) -> tuple[Blocks, NDArray[np.int64]]:
    """Round positions to a grid in each block, and sort each block by Morton code, so that differences are small.

    ``means`` ``[N, 3]`` are finite, in the order of ``coordinates.scene_order``; a coordinate of a cell has ``bits``, a
    block ``size`` Gaussians. Returns the blocks, and the permutation ``[N]`` from their order to rows of ``means``.
    """
    n = len(means)
    starts = np.arange(0, n, size)
    low, high = np.minimum.reduceat(means, starts), np.maximum.reduceat(means, starts)
    block = np.arange(n) // size
    extent = np.where(high > low, high.astype(np.float64) - low, 1.0)
    cells = np.rint((means.astype(np.float64) - low[block]) / extent[block] * (2**bits - 1)).astype(np.uint64)
    codes = interleave(cells)
    order = np.lexsort((codes, block))
    return Blocks(codes[order], low, high), order


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
    turned = _normalized(torch.from_numpy(np.einsum("rcn,nc->nr", products, turns[best]))).numpy()
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
        return quats_at(self.coefficients(values).round(), self.step)

    def coefficients(self, values: Tensor) -> Tensor:
        """Components x, y and z in steps, float64 ``[N, 3]``; gradients flow through them."""
        return _normalized(values.double())[:, 1:] / self.step


def quats_at(levels: Tensor, step: float) -> Tensor:
    """Unit quaternions wxyz ``[N, 4]``, float32, of levels of x, y and z ``[N, 3]``; w is positive."""
    x, y, z = (levels.double() * step).float().T
    # Written out: a reduction could round differently for another number of rows.
    square = x * x + y * y + z * z
    w = (1 - square).clamp_min(0).sqrt()
    length = (w * w + square).sqrt()
    return torch.stack([value / length for value in (w, x, y, z)], dim=1)


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
    return torch.stack([value / length for value in (w, x, y, z)], dim=1)


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
        return rows_at(self._levels(values), self.mean, self.basis, self.step)

    def coefficients(self, rows: Tensor) -> Tensor:
        """Coefficients in steps, float64 ``[N, D]``; gradients flow through them."""
        return (rows.double() - self.mean.double()) @ self.inverse / self.step

    def with_step(self, step: float, rows: Floats) -> Transform:
        """The same basis with another step, or a larger one where the largest coefficient of rows might not fit."""
        reach = torch.from_numpy(np.maximum(rows.max(axis=0), -rows.min(axis=0))) + self.mean.abs()
        highest = float((reach.double() @ self.inverse.abs()).max()) / step  # at most
        return replace(self, step=step * max(2 * highest / LARGEST, 1.0))

    def _levels(self, rows: Tensor) -> Tensor:
        parts = (self.coefficients(part) for part in rows.split(_PART if rows.is_cpu else len(rows)))
        return torch.cat([part.round_().clamp_(-LARGEST, LARGEST).float() for part in parts])


def fit_transform(rows: Floats, step: float, *, centred: bool = True, form: Tensor | None = None) -> Transform:
    """Fit a transform to finite rows ``[N, D]``, N and D at least 1.

    A larger ``step`` is used where the largest coefficient would not fit. Rows that are not ``centred`` on their mean
    keep zeros exact. ``form`` ``[D, D]``, positive definite, weighs errors e of rows by e' form e; coefficients are
    uncorrelated where this is the squared length. None or zeros stand for the identity.
    """
    mean = (rows.mean(axis=0, dtype=np.float64) if centred else np.zeros(rows.shape[1])).astype(np.float32)
    root, back = _roots(rows.shape[1], form)
    products = np.zeros_like(root)
    for start in range(0, len(rows), _PART):
        values = (rows[start : start + _PART].astype(np.float64) - mean) @ root
        # Rows weigh the square root of their length, and long ones no more, so that no huge row decides the basis.
        length = np.linalg.norm(values, axis=1, keepdims=True).clip(min=step)
        values /= np.sqrt(length * (length / (100 * step)).clip(min=1))
        products += values.T @ values
    axes = np.linalg.eigh(products)[1][:, ::-1].T @ back
    largest = float(np.abs(axes).max()) if form is not None else 1.0
    # Contiguous, as from a file: products of other layouts round differently.
    basis = np.ascontiguousarray(np.rint(axes / largest * _UNIT).astype(np.int8))
    # Invert the stored basis, so that its rounding adds no error.
    inverse = torch.from_numpy(np.linalg.inv(basis / _UNIT))
    fitted = Transform(torch.from_numpy(mean), torch.from_numpy(basis), inverse, step * largest)
    return fitted.with_step(fitted.step, rows)


def _roots(size: int, form: Tensor | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The symmetric root ``[D, D]`` of a form, scaled to a mean eigenvalue of 1, and its inverse."""
    if form is None or (mean := form.trace().item() / size) <= 0:  # a new head's last layer of zeros sees no feature
        return np.eye(size), np.eye(size)
    values, vectors = np.linalg.eigh(form.numpy() / mean)
    roots = np.sqrt(np.maximum(values, _LEAST_EIGENVALUE))
    return vectors * roots @ vectors.T, vectors / roots @ vectors.T


def rows_at(levels: Tensor, mean: Tensor, basis: Tensor, step: float) -> Tensor:
    """Rows ``[N, D]``, float32, of levels ``[N, D]`` of a :class:`Transform` with this mean, basis and step."""
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


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Mean squared change of the images' pixels per unit change of values; see ``sundae_ns.scene.packing``.

    ``rows`` are positive definite forms ``[C, C]``, float64, for changes of the rows ``[N, C]`` of attributes. ``head``
    is for the weights of each pair of channels ``[O, I]``, float64, of each tensor with more than one dimension.
    """

    rows: dict[str, Tensor]
    head: dict[str, Tensor]


@dataclass(frozen=True, eq=False)
class HeadCodec:
    """Weights of the head in steps of their channels. One-dimensional tensors stay float32.

    Of each other tensor, ``rows`` has the steps of output channels ``[O]``, ``columns`` factors for inputs ``[I]``.
    """

    rows: dict[str, Tensor]
    columns: dict[str, Tensor]

    def encode(self, head: Mapping[str, Tensor]) -> Coded:
        """The stored form, with the levels of all weights in one column; ``PackError`` if some are not finite."""
        values = {name: _on_cpu(head[name]) for name in sorted(head)}
        if not all(torch.isfinite(value).all() for value in values.values()):
            raise PackError("the head has weights that are not finite; go back to an earlier checkpoint")
        weights = [name for name, value in values.items() if value.ndim > 1]
        plain = [value.flatten() for value in values.values() if value.ndim <= 1]
        levels = [weight_levels(values[name], self.steps(name)).flatten() for name in weights]

        def joined(parts: list[Tensor]) -> Array:
            return torch.cat([*parts, torch.zeros(0)]).numpy()

        column = joined(levels)[:, None].astype(np.int32)
        shapes = [[name, list(value.shape)] for name, value in values.items()]
        about = {"codec": "channels", "weights": len(column), "tensors": shapes}
        steps, columns = ([side[name] for name in weights] for side in (self.rows, self.columns))
        return about, column, {"plain": joined(plain), "steps": joined(steps), "columns": joined(columns)}

    def rounded(self, name: str, values: Tensor) -> Tensor:
        """Return the values that a reader decodes for the tensor ``name``."""
        if values.ndim <= 1:
            return values
        step = self.steps(name)
        return weights_at(weight_levels(values, step), step)

    def scaled(self, factor: float, head: Mapping[str, Tensor]) -> HeadCodec:
        """Steps of the same ratios for a head, larger by a factor, but no output channel beyond its largest share."""
        largest = {name: weight_steps(_on_cpu(head[name]), _LARGEST_SHARE) for name in self.rows}
        rows = {name: torch.minimum(row * factor, torch.maximum(row, largest[name])) for name, row in self.rows.items()}
        return HeadCodec(rows, self.columns)

    def steps(self, name: str) -> Tensor:
        """Steps of a tensor ``[O, I]``, float32."""
        return self.rows[name][:, None] * self.columns[name]

    def coefficients(self, name: str, values: Tensor) -> Tensor:
        """Weights of a tensor in steps, flattened to ``[O, I]``; gradients flow through them."""
        return in_steps(values, self.steps(name)).flatten(1)


@dataclass(frozen=True, eq=False)
class Codecs:
    """Codecs of a whole scene; see :func:`fit_codecs`. ``blocks`` are the positions in their stored form."""

    config: PackConfig
    blocks: Blocks
    gaussians: dict[str, Rotations | Transform]
    head: HeadCodec | None

    def to(self, device: torch.device) -> Codecs:
        """Return a copy on another device."""

        def moved(value: Any) -> Any:
            if isinstance(value, dict):
                return {name: moved(inner) for name, inner in value.items()}
            if isinstance(value, (Rotations, Transform, HeadCodec)):
                return type(value)(**moved(vars(value)))
            return value.to(device) if isinstance(value, Tensor) else value

        return replace(self, gaussians=moved(self.gaussians), head=moved(self.head))

    def with_steps(self, config: PackConfig, gaussians: Mapping[str, Tensor], head: Mapping[str, Tensor]) -> Codecs:
        """The same grids and bases with the steps of other valid options; bits and blocks of positions stay.

        Gaussians, in the order of these codecs, and the head ({} for none) bound the steps.
        """
        ratios = {name: getattr(config, name) / getattr(self.config, name) for name in STEPS}
        codecs: dict[str, Rotations | Transform] = {}
        for name, codec in self.gaussians.items():
            step = codec.step * ratios[_STEPS[name]]
            codecs[name] = Rotations(step)
            if isinstance(codec, Transform):
                codecs[name] = codec.with_step(step, as_matrix(gaussians[name]))
        config = replace(config, position_bits=self.config.position_bits, block=self.config.block)
        return Codecs(config, self.blocks, codecs, self.head and self.head.scaled(ratios["head_step"], head))

    @torch.no_grad()
    def rounded(self, gaussians: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The Gaussians that a reader decodes, in the order of these codecs; positions are unchanged."""
        rounded = {name: codec.rounded(gaussians[name].flatten(1)) for name, codec in self.gaussians.items()}
        return {**gaussians, **{name: value.reshape(gaussians[name].shape) for name, value in rounded.items()}}

    @torch.no_grad()
    def rounded_head(self, head: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the head that a reader decodes."""
        return {name: value if self.head is None else self.head.rounded(name, value) for name, value in head.items()}


def fit_codecs(
    gaussians: Mapping[str, Tensor], head: Mapping[str, Tensor], config: PackConfig, sensitivity: Sensitivity
) -> tuple[dict[str, Tensor], Codecs]:
    """Gaussians in the stored order, with rounded positions, and codecs fitted to them and to a head; {} for none."""
    values = {name: as_matrix(gaussians[name]) for name in (*SPLAT_NAMES, FEATURES) if name in gaussians}
    order, near = scene_order(values["means"])
    filled = min(range(config.block, max(config.block // 2, 15), -1), key=lambda size: max(near % size, 16))
    widths = np.exp(values["scales"].max(axis=1).clip(max=80))
    finer = range(config.position_bits, min(config.position_bits + 4, 16) + 1)
    smaller = (max(config.block >> by, 16) for by in (2, 4, 6))
    # What lies far away makes a block coarse: another bit for each coordinate costs less than smaller blocks.
    layouts = [(config.block, config.position_bits), *itertools.product((filled, *smaller), finer)]
    coarse: list[float] = []
    # The finest first: no cells suit what training has shrunk to nothing, and it must not ask for these.
    for block, bits in (layouts[-1], *layouts):
        blocks, within = quantize_positions(values["means"][order], bits, block)
        grid = ((blocks.high.astype(np.float64) - blocks.low) / 2**bits).max(axis=1)
        coarse.append((grid[np.arange(len(order)) // block] > 3 * widths[order[within]])[:near].mean())
        if len(coarse) > 1 and coarse[-1] <= coarse[0] + 1e-3:
            break
    config = replace(config, block=block, position_bits=bits)
    values = {name: value[order[within]] for name, value in values.items()}
    values["means"] = blocks.positions(config.position_bits, config.block)
    values["quats"], values["scales"] = aligned(values["quats"], values["scales"])
    values["opacities"] = values["opacities"].clip(*_LOGITS)
    codecs: dict[str, Rotations | Transform] = {"quats": Rotations(config.rotation_step)}
    for name, option in _STEPS.items():
        if name != "quats" and name in values and values[name].size:
            step = getattr(config, option)
            form = sensitivity.rows.get(name)
            codecs[name] = fit_transform(values[name], step, centred=name != "features_rest", form=form)
    ordered = {name: torch.from_numpy(values[name]).reshape(gaussians[name].shape) for name in values}
    return ordered, Codecs(config, blocks, codecs, _fit_head(head, config.head_step, sensitivity.head))


def _fit_head(head: Mapping[str, Tensor], share: float, sensitivity: Mapping[str, Tensor]) -> HeadCodec | None:
    """Steps of a share of each output channel's largest weight, or, by a sensitivity, of the same total error."""
    # Steps in inverse proportion to the root of the sensitivity take the fewest bits for an error.
    if not head:
        return None
    weights = {name: _on_cpu(value) for name, value in head.items() if value.ndim > 1}
    rows = {name: weight_steps(value, share) for name, value in weights.items()}
    columns = {name: torch.ones(value.shape[1]) for name, value in weights.items()}
    mean = max((float(value.mean()) for value in sensitivity.values()), default=0.0)
    if weights.keys() != sensitivity.keys() or mean <= 0:
        return HeadCodec(rows, columns)
    error = target = 0.0
    for name, value in weights.items():
        # All of a layer's derivatives are zero where a later layer is, as in a head that was enabled just now.
        least = max(1e-3 * float(sensitivity[name].mean()), 1e-9 * mean)
        loss = sensitivity[name].clamp_min(least)
        count = value[0, 0].numel()  # weights of a pair of channels
        target += count * float((loss * rows[name].double()[:, None] ** 2).sum())
        row, column = loss.mean(dim=1), loss.mean(dim=0) / loss.mean()
        rows[name], columns[name] = (_quarters(side.rsqrt()) for side in (row, column))
        error += count * float((loss * (rows[name][:, None] * columns[name]).double() ** 2).sum())
    factor = _quarters(torch.tensor((target / error) ** 0.5))
    for name, value in weights.items():
        # A derivative says nothing of changes as large as the weights: in an untrained head they all seem useless.
        rows[name] = torch.minimum(rows[name] * factor, _quarters(weight_steps(value, _LARGEST_SHARE)))
    return HeadCodec(rows, columns)


def _quarters(values: Tensor) -> Tensor:
    """Powers of 2^(1/4) near positive values, float32; they take few bytes in a file."""
    return torch.exp2((4 * values.double().clamp_min(1e-30).log2()).round() / 4).float()


def as_matrix(values: Tensor) -> Floats:
    """Return a tensor ``[N, ...]`` as contiguous float32 ``[N, C]`` on the CPU."""
    return np.ascontiguousarray(_on_cpu(values).numpy().reshape(len(values), -1))


def _on_cpu(values: Tensor) -> Tensor:
    return values.detach().to("cpu", torch.float32)


def estimated_bits(codecs: Codecs, gaussians: Mapping[str, Tensor], head: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Estimate, with gradients, the bits of each attribute of Gaussians but positions, and of a head; {} for none.

    A rounded number of the distribution of Laplace with mean magnitude m takes about log2(1 + 2 e m) bits. The entropy
    coder's contexts know the magnitude nearby, so m is measured in runs along the curve. The codecs are on the device
    of the Gaussians, which are in their order.
    """
    bits = {name: _of_rows(codec.coefficients(gaussians[name].flatten(1))) for name, codec in codecs.gaussians.items()}
    if codecs.head is not None and head:
        levels = [codecs.head.coefficients(name, value) for name, value in head.items() if value.ndim > 1]
        bits["head"] = torch.stack([_of_magnitudes(level.abs().mean(dim=1), level.shape[1]) for level in levels]).sum()
    return bits


def _of_rows(levels: Tensor) -> Tensor:
    """Bits of levels ``[N, C]``: the mean of each run, and the deviations from it."""
    n, width = levels.shape
    in_runs = n // _RUN * _RUN
    runs = [levels[:in_runs].reshape(-1, _RUN, width), levels[in_runs:].reshape(-1, max(n - in_runs, 1), width)]
    total = levels.new_zeros(())
    for run in filter(torch.numel, runs):
        means = run.mean(dim=1, keepdim=True)
        deviations = (run - means).abs().mean(dim=1)
        total = total + _of_magnitudes(deviations, run.shape[1]) + _of_magnitudes(means.abs(), 1)
    return total


def _of_magnitudes(means: Tensor, count: int) -> Tensor:
    """Bits of groups of ``count`` levels with these mean magnitudes."""
    return count * torch.log1p(2 * math.e * means).sum() / math.log(2)
