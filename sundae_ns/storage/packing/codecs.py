"""How each attribute of a scene is rounded: grids, bases, books and steps, fitted once, then used to write and to train.

A codec has two sides. ``encode`` makes what is stored of an attribute; ``rounded`` makes the values that a reader will decode
from it, without the detour, on the device of its argument. On a CPU they are the same to the bit.
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
"""What the header says of an attribute, and its sections, by what they are of it."""
Moved = TypeVar("Moved")


class Codec(Protocol):
    """How one attribute ``[N, C]`` is stored."""

    def encode(self, values: Floats) -> Encoded:
        """What is stored."""
        ...

    def rounded(self, values: Tensor) -> Tensor:
        """What will be read."""
        ...


@dataclass(frozen=True, eq=False)
class UniformCodec:
    """Even levels a channel."""

    grid: Grid
    differences: bool = False
    """Whether channels 0 and 2 of three are told by how far they are from channel 1, as those of a colour are alike."""

    def encode(self, values: Floats) -> Encoded:
        """What is stored."""
        made = quantize.quantize(values, self.grid)
        about = {
            "codec": "uniform",
            "bits": self.grid.bits,
            "low": made.low.tolist(),
            "step": made.step.tolist(),
            "bound": (made.step / 2).tolist(),
        }
        codes = made.codes
        if self.differences:
            about["differences"] = True
            codes = np.stack([codes[0] - codes[1], codes[1], codes[2] - codes[1]])
        return about, {"codes": codes, "places": made.places, "exceptions": made.exceptions}

    def rounded(self, values: Tensor) -> Tensor:
        """What will be read."""
        return quantize.rounded(values, self.grid)


@dataclass(frozen=True, eq=False)
class RotationCodec:
    """Smallest three."""

    bits: int

    def encode(self, values: Floats) -> Encoded:
        """What is stored."""
        made = quantize.quantize_rotations(values, self.bits)
        about = {"codec": "smallest-three", "bits": self.bits, "bound": quantize.rotation_bound(self.bits)}
        return about, {"codes": made.codes, "largest": join_crumbs(made.largest)}

    def rounded(self, values: Tensor) -> Tensor:
        """What will be read."""
        return quantize.rounded_rotations(values, self.bits)


@dataclass(frozen=True, eq=False)
class TransformCodec:
    """Karhunen-Loeve transform, rounded."""

    basis: Basis

    def encode(self, values: Floats) -> Encoded:
        """What is stored."""
        made = transform.forward(values, self.basis)
        arrays: dict[str, Array] = {
            "codes": made.codes,
            "basis": made.basis.reshape(-1),
            "rows": made.rows,
            "exact": made.exact,
        }
        about = {"codec": "transform", "step": made.step, "bound": transform.bound(made)}
        return about, arrays

    def rounded(self, values: Tensor) -> Tensor:
        """What will be read."""
        return transform.rounded(values, self.basis)


@dataclass(frozen=True, eq=False)
class BooksCodec:
    """Residual codebooks."""

    books: Books

    def encode(self, values: Floats) -> Encoded:
        """What is stored."""
        made = codebooks.encode(values, self.books)
        arrays: dict[str, Array] = {
            "indices": made.indices,
            "entries": made.entries.reshape(len(made.entries), -1),
            "steps": made.steps,
            "rows": made.rows,
            "exact": made.exact,
        }
        about = {"codec": "codebooks", "width": values.shape[1], "bound": made.bound}
        return about, arrays

    def rounded(self, values: Tensor) -> Tensor:
        """What will be read."""
        return codebooks.rounded(values, self.books)


@dataclass(frozen=True, eq=False)
class HeadCodec:
    """Weights of a network: int8 with a step for each output channel, or fp16; tensors of one dimension stay as they are."""

    bits: int
    """Of each weight, at most 8; 16 stands for fp16."""
    steps: dict[str, Tensor]
    """Of each tensor that has more than one dimension ``[O]``; empty for fp16."""

    def encode(self, head: Mapping[str, Tensor]) -> Encoded:
        """What is stored.

        Raises:
            PackError: there are weights that are not finite, or too large for fp16.
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
        """What will be read of the tensor of this name."""
        if values.ndim <= 1:
            return values
        return (
            quantize.rounded_weights(values, self.steps[name], self.bits) if self.bits <= 8 else values.half().float()
        )

    def within(self, name: str, values: Tensor) -> Tensor:
        """Weights cut to what the steps reach, which were fitted to earlier ones."""
        if name not in self.steps:
            return values
        most = self.steps[name] * (2 ** (self.bits - 1) - 1)
        most = most.reshape(-1, *([1] * (values.ndim - 1)))
        return values.clamp(-most, most)


class Codecs(NamedTuple):
    """How a whole scene is stored; see :func:`fit`."""

    config: PackConfig
    blocks: Blocks
    """Positions, as they are stored."""
    field: dict[str, Codec]
    """All attributes but positions."""
    head: HeadCodec | None

    def to(self, device: torch.device) -> Codecs:
        """The same on another device."""
        return _moved(self, device)

    @torch.no_grad()
    def rounded(self, field: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """What will be read of a field whose primitives stand in the order of these codecs; positions stay as they are."""
        made = dict(field)
        for name, codec in self.field.items():
            values = field[name]
            made[name] = codec.rounded(values.reshape(len(values), -1)).reshape(values.shape)
        return made

    @torch.no_grad()
    def rounded_head(self, head: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """What will be read of the head."""
        return {name: value if self.head is None else self.head.rounded(name, value) for name, value in head.items()}


def _moved(value: Moved, device: torch.device) -> Moved:
    """Tensors in tuples, mappings and data classes, moved."""
    made: Any = value
    if isinstance(value, Tensor):
        made = value.to(device)
    elif isinstance(value, tuple) and hasattr(value, "_fields"):
        made = type(value)(*(_moved(inner, device) for inner in value))
    elif isinstance(value, dict):
        made = {name: _moved(inner, device) for name, inner in value.items()}
    elif isinstance(value, (UniformCodec, TransformCodec, BooksCodec, HeadCodec)):
        made = replace(value, **{field.name: _moved(getattr(value, field.name), device) for field in fields(value)})
    return made


def fit(
    field: Mapping[str, Tensor], head: Mapping[str, Tensor], config: PackConfig
) -> tuple[dict[str, Tensor], Codecs]:
    """Choose how to store a field and a head.

    Args:
        field: parameters as ``gaussians.parameters`` has them, at least one primitive, all finite.
        head: state of the compensation head; empty without one.
        config: in how many bits.

    Returns:
        The field in the order in which it is stored, its positions already rounded, and the codecs.
    """
    names = [name for name in (*SPLAT_NAMES, FEATURES) if name in field]
    values = {name: as_matrix(field[name]) for name in names}
    order = scene_order(values["means"])
    blocks, within = quantize.quantize_positions(values["means"][order], config.position_bits, config.block)
    order = order[within]
    values = {name: value[order] for name, value in values.items()}
    made: dict[str, Codec] = {
        "quats": RotationCodec(config.rotation_bits),
        "scales": UniformCodec(quantize.fit_grid(values["scales"], config.scale_bits)),
        "opacities": UniformCodec(quantize.fit_grid(values["opacities"], config.opacity_bits)),
        "features_dc": UniformCodec(quantize.fit_grid(values["features_dc"], config.color_bits, shared=True), True),
    }
    rest = values["features_rest"]
    if rest.shape[1]:
        if config.harmonics == "transform":
            made["features_rest"] = TransformCodec(transform.fit_basis(rest, config.harmonics_step))
        else:
            made["features_rest"] = _books(rest, config.harmonics_books)
    if FEATURES in values and config.feature_books:
        made[FEATURES] = _books(values[FEATURES], config.feature_books)
    elif FEATURES in values:
        made[FEATURES] = UniformCodec(quantize.fit_grid(values[FEATURES], config.feature_bits))
    positions = quantize.dequantize_positions(blocks, config.position_bits, min(config.block, len(order)))
    ordered = {name: torch.from_numpy(values[name]).reshape(field[name].shape) for name in names}
    return {**ordered, "means": torch.from_numpy(positions)}, Codecs(config, blocks, made, _fit_head(head, config))


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
    """float32 on the CPU."""
    array: Floats = values.detach().to("cpu", torch.float32).numpy()
    return array


def as_matrix(values: Tensor) -> Floats:
    """``[N, ...]`` as contiguous float32 ``[N, C]`` on the CPU."""
    return np.ascontiguousarray(as_array(values).reshape(len(values), -1))


def join_crumbs(values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Numbers of two bits ``[N]``, four to a byte, the first lowest."""
    padded = np.zeros(-(-len(values) // 4) * 4, np.uint8)
    padded[: len(values)] = values
    four = padded.reshape(-1, 4)
    joined: NDArray[np.uint8] = np.bitwise_or.reduce(four << np.array([0, 2, 4, 6], np.uint8), axis=1)
    return joined


def part_crumbs(packed: NDArray[np.uint8], n: int) -> NDArray[np.uint8]:
    """Counterpart of :func:`join_crumbs`."""
    parted: NDArray[np.uint8] = packed[:, None] >> np.array([0, 2, 4, 6], np.uint8) & np.uint8(3)
    return parted.reshape(-1)[:n]
