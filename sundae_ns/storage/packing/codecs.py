"""Codecs of the attributes of a scene, fitted once, then used for writing and for training with rounding.

``encode`` returns the stored form of an attribute. ``rounded`` returns the values that a reader decodes from it,
directly and on the device of its argument; on a CPU they are equal bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.errors import PackError
from sundae_ns.gaussians.parameters import FEATURES, SPLAT_NAMES
from sundae_ns.storage.packing import codebooks, quantize, transform
from sundae_ns.storage.packing.codebooks import Books
from sundae_ns.storage.packing.config import PackConfig
from sundae_ns.storage.packing.container import Array
from sundae_ns.storage.packing.morton import scene_order
from sundae_ns.storage.packing.quantize import Blocks, Grid
from sundae_ns.storage.packing.transform import Basis

Floats = NDArray[np.float32]
Encoded = tuple[dict[str, Any], dict[str, Array]]
"""Entry of an attribute in the header, and its sections by name."""
T = TypeVar("T")


class Codec(Protocol):
    """Codec of one attribute ``[N, C]``."""

    def encode(self, values: Floats) -> Encoded:
        """Return the stored form."""
        ...

    def rounded(self, values: Tensor) -> Tensor:
        """Return the values that a reader decodes."""
        ...


@dataclass(frozen=True, eq=False)
class UniformCodec:
    """Uniform quantisation of each channel."""

    grid: Grid
    differences: bool = False
    """Store channels 0 and 2 of a colour as differences from channel 1, because they correlate."""

    def encode(self, values: Floats) -> Encoded:
        """Return the stored form."""
        packed = quantize.quantize(values, self.grid)
        about = {
            "codec": "uniform",
            "bits": self.grid.bits,
            "low": packed.low.tolist(),
            "step": packed.step.tolist(),
            "bound": (packed.step / 2).tolist(),
        }
        codes = packed.codes
        if self.differences:
            about["differences"] = True
            codes = np.stack([codes[0] - codes[1], codes[1], codes[2] - codes[1]])
        return about, {"codes": codes, "places": packed.places, "exceptions": packed.exceptions}

    def rounded(self, values: Tensor) -> Tensor:
        """Return the values that a reader decodes."""
        return quantize.rounded(values, self.grid)


@dataclass(frozen=True, eq=False)
class RotationCodec:
    """The three smallest components of each quaternion."""

    bits: int

    def encode(self, values: Floats) -> Encoded:
        """Return the stored form."""
        packed = quantize.quantize_rotations(values, self.bits)
        about = {"codec": "smallest-three", "bits": self.bits, "bound": quantize.rotation_bound(self.bits)}
        return about, {"codes": packed.codes, "largest": pack_pairs_of_bits(packed.largest)}

    def rounded(self, values: Tensor) -> Tensor:
        """Return the values that a reader decodes."""
        return quantize.rounded_rotations(values, self.bits)


@dataclass(frozen=True, eq=False)
class TransformCodec:
    """Karhunen-Loeve transform with rounded coefficients."""

    basis: Basis

    def encode(self, values: Floats) -> Encoded:
        """Return the stored form."""
        packed = transform.forward(values, self.basis)
        arrays: dict[str, Array] = {
            "codes": packed.codes,
            "basis": packed.basis.reshape(-1),
            "rows": packed.rows,
            "exact": packed.exact,
        }
        about = {"codec": "transform", "step": packed.step, "bound": transform.bound(packed)}
        return about, arrays

    def rounded(self, values: Tensor) -> Tensor:
        """Return the values that a reader decodes."""
        return transform.rounded(values, self.basis)


@dataclass(frozen=True, eq=False)
class BooksCodec:
    """Residual codebooks."""

    books: Books

    def encode(self, values: Floats) -> Encoded:
        """Return the stored form."""
        packed = codebooks.encode(values, self.books)
        arrays: dict[str, Array] = {
            "indices": packed.indices,
            "entries": packed.entries.reshape(len(packed.entries), -1),
            "steps": packed.steps,
            "rows": packed.rows,
            "exact": packed.exact,
        }
        about = {"codec": "codebooks", "width": values.shape[1], "bound": packed.bound}
        return about, arrays

    def rounded(self, values: Tensor) -> Tensor:
        """Return the values that a reader decodes."""
        return codebooks.rounded(values, self.books)


@dataclass(frozen=True, eq=False)
class HeadCodec:
    """Weights of the head: int8 with one step per output channel, or fp16. One-dimensional tensors stay float32."""

    bits: int
    """Bits of each weight, at most 8; 16 means fp16."""
    steps: dict[str, Tensor]
    """Steps ``[O]`` of each tensor with more than one dimension; empty for fp16."""

    def encode(self, head: Mapping[str, Tensor]) -> Encoded:
        """Return the stored form.

        Raises:
            PackError: weights are not finite, or too large for fp16.
        """
        names = sorted(head)
        values = {name: as_array(head[name]) for name in names}
        if not all(np.isfinite(value).all() for value in values.values()):
            raise PackError("the head has weights that are not finite; go back to an earlier checkpoint")
        weights = [name for name in names if values[name].ndim > 1]
        none = np.zeros(0, np.float32)
        plain = [values[name].reshape(-1) for name in names if values[name].ndim <= 1]
        arrays: dict[str, Array] = {"plain": np.concatenate([*plain, none])}
        if self.bits <= 8:
            steps = [as_array(self.steps[name]) for name in weights]
            codes = [quantize.quantize_weights(values[name], step, self.bits) for name, step in zip(weights, steps)]
            arrays["weights"] = np.concatenate([*(code.reshape(-1) for code in codes), np.zeros(0, np.int8)])
            arrays["steps"] = np.concatenate([*steps, none])
        else:
            largest = max((float(np.abs(values[name]).max(initial=0.0)) for name in weights), default=0.0)
            if largest > np.finfo(np.float16).max:
                raise PackError(f"the head has a weight of {largest:.3g}, too large for fp16; pack it with int8")
            flat = np.concatenate([*(values[name].reshape(-1) for name in weights), none])
            arrays["weights"] = flat.astype(np.float16)
        tensors = [[name, list(values[name].shape)] for name in names]
        return {"codec": "int8" if self.bits <= 8 else "fp16", "tensors": tensors}, arrays

    def rounded(self, name: str, values: Tensor) -> Tensor:
        """Return the values that a reader decodes for the tensor ``name``."""
        if values.ndim <= 1:
            return values
        return (
            quantize.rounded_weights(values, self.steps[name], self.bits) if self.bits <= 8 else values.half().float()
        )

    def within(self, name: str, values: Tensor) -> Tensor:
        """Clamp weights to the range of the steps, which were fitted to earlier weights."""
        if name not in self.steps:
            return values
        limit = self.steps[name] * (2 ** (self.bits - 1) - 1)
        limit = limit.reshape(-1, *([1] * (values.ndim - 1)))
        return values.clamp(-limit, limit)


class Codecs(NamedTuple):
    """Codecs of a whole scene; see :func:`fit`."""

    config: PackConfig
    blocks: Blocks
    """The positions in their stored form."""
    field: dict[str, Codec]
    """Codecs of all other attributes."""
    head: HeadCodec | None

    def to(self, device: torch.device) -> Codecs:
        """Return a copy on another device."""
        return _moved(self, device)

    @torch.no_grad()
    def rounded(self, field: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the field that a reader decodes; positions are unchanged.

        Args:
            field: primitives in the order of these codecs.
        """
        result = dict(field)
        for name, codec in self.field.items():
            values = field[name]
            result[name] = codec.rounded(values.reshape(len(values), -1)).reshape(values.shape)
        return result

    @torch.no_grad()
    def rounded_head(self, head: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the head that a reader decodes."""
        return {name: value if self.head is None else self.head.rounded(name, value) for name, value in head.items()}


def _moved(value: T, device: torch.device) -> T:
    """Copy a structure of named tuples, dictionaries and codecs, with its tensors on ``device``."""
    moved: Any = value
    if isinstance(value, Tensor):
        moved = value.to(device)
    elif isinstance(value, tuple) and hasattr(value, "_fields"):
        moved = type(value)(*(_moved(inner, device) for inner in value))
    elif isinstance(value, dict):
        moved = {name: _moved(inner, device) for name, inner in value.items()}
    elif isinstance(value, (UniformCodec, TransformCodec, BooksCodec, HeadCodec)):
        moved = replace(value, **{field.name: _moved(getattr(value, field.name), device) for field in fields(value)})
    return moved


def fit(
    field: Mapping[str, Tensor], head: Mapping[str, Tensor], config: PackConfig
) -> tuple[dict[str, Tensor], Codecs]:
    """Fit codecs to a field and a head.

    Args:
        field: see :mod:`sundae_ns.gaussians.parameters`; at least one primitive, all finite.
        head: state of the head; empty without a head.
        config: bits and codec of each attribute.

    Returns:
        The field in the stored order, with rounded positions, and the codecs.
    """
    names = [name for name in (*SPLAT_NAMES, FEATURES) if name in field]
    values = {name: as_matrix(field[name]) for name in names}
    order = scene_order(values["means"])
    blocks, within = quantize.quantize_positions(values["means"][order], config.position_bits, config.block)
    order = order[within]
    values = {name: value[order] for name, value in values.items()}
    codecs: dict[str, Codec] = {
        "quats": RotationCodec(config.rotation_bits),
        "scales": UniformCodec(quantize.fit_grid(values["scales"], config.scale_bits)),
        "opacities": UniformCodec(quantize.fit_grid(values["opacities"], config.opacity_bits)),
        "features_dc": UniformCodec(quantize.fit_grid(values["features_dc"], config.color_bits, shared=True), True),
    }
    rest = values["features_rest"]
    if rest.shape[1]:
        if config.harmonics == "transform":
            codecs["features_rest"] = TransformCodec(transform.fit_basis(rest, config.harmonics_step))
        else:
            codecs["features_rest"] = _books(rest, config.harmonics_books)
    if FEATURES in values and config.feature_books:
        codecs[FEATURES] = _books(values[FEATURES], config.feature_books)
    elif FEATURES in values:
        codecs[FEATURES] = UniformCodec(quantize.fit_grid(values[FEATURES], config.feature_bits))
    positions = quantize.dequantize_positions(blocks, config.position_bits, min(config.block, len(order)))
    ordered = {name: torch.from_numpy(values[name]).reshape(field[name].shape) for name in names}
    return {**ordered, "means": torch.from_numpy(positions)}, Codecs(config, blocks, codecs, _fit_head(head, config))


def _books(values: Floats, books: int) -> BooksCodec:
    return BooksCodec(codebooks.books_of(codebooks.fit(values, books)))


def _fit_head(head: Mapping[str, Tensor], config: PackConfig) -> HeadCodec | None:
    if not head:
        return None
    if config.head == "fp16":
        return HeadCodec(16, {})
    weights = {name: torch.from_numpy(as_array(value)) for name, value in head.items() if value.ndim > 1}
    return HeadCodec(
        config.head_bits, {name: quantize.weight_steps(value, config.head_bits) for name, value in weights.items()}
    )


def as_array(values: Tensor) -> Floats:
    """Return a tensor as float32 on the CPU."""
    array: Floats = values.detach().to("cpu", torch.float32).numpy()
    return array


def as_matrix(values: Tensor) -> Floats:
    """Return a tensor ``[N, ...]`` as contiguous float32 ``[N, C]`` on the CPU."""
    return np.ascontiguousarray(as_array(values).reshape(len(values), -1))


def pack_pairs_of_bits(values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pack two-bit numbers ``[N]`` four to a byte, the first in the lowest bits."""
    padded = np.zeros(-(-len(values) // 4) * 4, np.uint8)
    padded[: len(values)] = values
    four = padded.reshape(-1, 4)
    joined: NDArray[np.uint8] = np.bitwise_or.reduce(four << np.array([0, 2, 4, 6], np.uint8), axis=1)
    return joined


def unpack_pairs_of_bits(packed: NDArray[np.uint8], n: int) -> NDArray[np.uint8]:
    """Return the ``n`` numbers given to :func:`pack_pairs_of_bits`."""
    four: NDArray[np.uint8] = packed[:, None] >> np.array([0, 2, 4, 6], np.uint8) & np.uint8(3)
    return four.reshape(-1)[:n]
