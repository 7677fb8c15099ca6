"""Codecs of the attributes of a scene, fitted once, then used for writing and for training with rounding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from sundae_ns.errors import PackError
from sundae_ns.gaussians.parameters import FEATURES, SPLAT_NAMES
from sundae_ns.storage.packing import quantize, transform
from sundae_ns.storage.packing.config import PackConfig
from sundae_ns.storage.packing.container import Array, Encoded, Floats
from sundae_ns.storage.packing.morton import scene_order
from sundae_ns.storage.packing.quantize import Blocks, Rotations, fit_uniform


class Codec(Protocol):
    """Codec of one attribute ``[N, C]``."""

    def encode(self, values: Floats) -> Encoded:
        """Return the stored form."""

    def rounded(self, values: Tensor) -> Tensor:
        """Return the values that a reader decodes, on the device of ``values``; on a CPU bit for bit."""


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
            tensors = [(torch.from_numpy(values[name]), self.steps[name]) for name in weights]
            levels = [quantize.weight_levels(value, step, self.bits) for value, step in tensors]
            codes = [level.flatten().to(torch.int8).numpy() for level in levels]
            arrays["weights"] = np.concatenate([*codes, np.zeros(0, np.int8)])
            arrays["steps"] = np.concatenate([*(self.steps[name].numpy() for name in weights), none])
        else:
            largest = max((float(np.abs(values[name]).max(initial=0.0)) for name in weights), default=0.0)
            if largest > np.finfo(np.float16).max:
                raise PackError(f"the head has a weight of {largest:.3g}, too large for fp16; pack it with int8")
            flat = np.concatenate([*(values[name].reshape(-1) for name in weights), none])
            arrays["weights"] = flat.astype(np.float16)
        shapes = [[name, list(values[name].shape)] for name in names]
        return {"codec": "int8" if self.bits <= 8 else "fp16", "tensors": shapes}, arrays

    def rounded(self, name: str, values: Tensor) -> Tensor:
        """Return the values that a reader decodes for the tensor ``name``."""
        if values.ndim <= 1:
            return values
        if self.bits > 8:
            return values.half().float()
        step = self.steps[name]
        return quantize.weights_at(quantize.weight_levels(values, step, self.bits), step)

    def within(self, name: str, values: Tensor) -> Tensor:
        """Clamp weights to the range of the steps, which were fitted to earlier weights."""
        if name not in self.steps:
            return values
        limit = self.steps[name] * (2 ** (self.bits - 1) - 1)
        limit = limit.reshape(-1, *([1] * (values.ndim - 1)))
        return values.clamp(-limit, limit)


@dataclass(frozen=True, eq=False)
class Codecs:
    """Codecs of a whole scene; see :func:`fit`."""

    config: PackConfig
    blocks: Blocks
    """The positions in their stored form."""
    field: dict[str, Codec]
    """Codecs of all other attributes."""
    head: HeadCodec | None

    def to(self, device: torch.device) -> Codecs:
        """Return a copy on another device."""
        moved: Codecs = _moved(self, device)
        return moved

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


def _moved(value: Any, device: torch.device) -> Any:
    """Copy a structure of dictionaries and dataclasses, with its tensors on ``device``."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {name: _moved(inner, device) for name, inner in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: _moved(getattr(value, field.name), device) for field in fields(value)})
    return value


def fit(
    field: Mapping[str, Tensor], head: Mapping[str, Tensor], config: PackConfig
) -> tuple[dict[str, Tensor], Codecs]:
    """Fit codecs to a field and a head, which may be empty; see :func:`sundae_ns.storage.packing.fit_scene`."""
    names = [name for name in (*SPLAT_NAMES, FEATURES) if name in field]
    values = {name: as_matrix(field[name]) for name in names}
    order = scene_order(values["means"])
    blocks, within = quantize.quantize_positions(values["means"][order], config.position_bits, config.block)
    order = order[within]
    values = {name: value[order] for name, value in values.items()}
    codecs: dict[str, Codec] = {
        "quats": Rotations(config.rotation_bits),
        "scales": fit_uniform(values["scales"], config.scale_bits),
        "opacities": fit_uniform(values["opacities"], config.opacity_bits),
        "features_dc": fit_uniform(values["features_dc"], config.color_bits, color=True),
    }
    rest = values["features_rest"]
    if rest.shape[1]:
        codecs["features_rest"] = transform.fit(rest, config.harmonics_step)
    if FEATURES in values:
        codecs[FEATURES] = fit_uniform(values[FEATURES], config.feature_bits)
    positions = quantize.dequantize_positions(blocks, config.position_bits, min(config.block, len(order)))
    ordered = {name: torch.from_numpy(values[name]).reshape(field[name].shape) for name in names}
    return {**ordered, "means": torch.from_numpy(positions)}, Codecs(config, blocks, codecs, _fit_head(head, config))


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
