"""Codecs of the attributes of a scene, fitted once, then used for writing and for training with rounding."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sundae_ns.core.errors import PackError
from sundae_ns.core.gaussians import FEATURES, SPLAT_NAMES
from sundae_ns.io.coordinates import scene_order
from sundae_ns.io.pack import quantize
from sundae_ns.io.pack.config import STEPS, PackConfig
from sundae_ns.io.pack.container import Array, Coded, Floats
from sundae_ns.io.pack.quantize import Blocks, Rotations, Transform, fit_transform

_LOGITS = (-6.0, 8.0)  # opacities outside look the same as at these: below 1/255 nothing is drawn
_STEPS = {
    "quats": "rotation_step",
    "scales": "scale_step",
    "opacities": "opacity_step",
    "features_dc": "color_step",
    "features_rest": "harmonics_step",
    FEATURES: "feature_step",
}  # options of the steps of attributes
_LARGEST_SHARE = 0.5  # step of an output channel of the head, at most, relative to its largest weight
_RUN = 16  # neighbours on the curve whose levels share a mean and a magnitude, in the estimate of bits


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
        names = sorted(head)
        values = {name: _on_cpu(head[name]) for name in names}
        if not all(torch.isfinite(value).all() for value in values.values()):
            raise PackError("the head has weights that are not finite; go back to an earlier checkpoint")
        weights = [name for name in names if values[name].ndim > 1]
        plain = [values[name].flatten() for name in names if name not in weights]
        levels = [quantize.weight_levels(values[name], self.steps(name)).flatten() for name in weights]

        def joined(parts: list[Tensor]) -> Array:
            return torch.cat([*parts, torch.zeros(0)]).numpy()

        column = joined(levels)[:, None].astype(np.int32)
        shapes = [[name, list(values[name].shape)] for name in names]
        about = {"codec": "channels", "weights": len(column), "tensors": shapes}
        steps, columns = ([side[name] for name in weights] for side in (self.rows, self.columns))
        return about, column, {"plain": joined(plain), "steps": joined(steps), "columns": joined(columns)}

    def rounded(self, name: str, values: Tensor) -> Tensor:
        """Return the values that a reader decodes for the tensor ``name``."""
        if values.ndim <= 1:
            return values
        step = self.steps(name)
        return quantize.weights_at(quantize.weight_levels(values, step), step)

    def scaled(self, factor: float, head: Mapping[str, Tensor]) -> HeadCodec:
        """Steps of the same ratios for a head, larger by a factor, but no output channel beyond its largest share."""
        rows = {}
        for name, row in self.rows.items():
            largest = quantize.weight_steps(_on_cpu(head[name]), _LARGEST_SHARE)
            rows[name] = torch.minimum(row * factor, torch.maximum(row, largest))
        return HeadCodec(rows, self.columns)

    def steps(self, name: str) -> Tensor:
        """Steps of a tensor ``[O, I]``, float32."""
        return self.rows[name][:, None] * self.columns[name]

    def coefficients(self, name: str, values: Tensor) -> Tensor:
        """Weights of a tensor in steps, flattened to ``[O, I]``; gradients flow through them."""
        return quantize.in_steps(values, self.steps(name)).flatten(1)


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
            if isinstance(codec, Transform):
                codecs[name] = codec.with_step(step, as_matrix(gaussians[name]))
            else:
                codecs[name] = Rotations(step)
        kept = {"position_bits": self.config.position_bits, "block": self.config.block}
        of_head = None if self.head is None else self.head.scaled(ratios["head_step"], head)
        return Codecs(replace(config, **kept), self.blocks, codecs, of_head)  # type: ignore[arg-type]

    @torch.no_grad()
    def rounded(self, gaussians: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The Gaussians that a reader decodes, in the order of these codecs; positions are unchanged."""
        result = dict(gaussians)
        for name, codec in self.gaussians.items():
            values = gaussians[name]
            result[name] = codec.rounded(values.reshape(len(values), -1)).reshape(values.shape)
        return result

    @torch.no_grad()
    def rounded_head(self, head: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the head that a reader decodes."""
        return {name: value if self.head is None else self.head.rounded(name, value) for name, value in head.items()}


def fit_codecs(
    gaussians: Mapping[str, Tensor],
    head: Mapping[str, Tensor],
    config: PackConfig,
    sensitivity: Sensitivity | None = None,
) -> tuple[dict[str, Tensor], Codecs]:
    """Gaussians in the stored order, with rounded positions, and codecs fitted to them and to a head; {} for none."""
    names = [name for name in (*SPLAT_NAMES, FEATURES) if name in gaussians]
    values = {name: as_matrix(gaussians[name]) for name in names}
    order = scene_order(values["means"])
    blocks, within = quantize.quantize_positions(values["means"][order], config.position_bits, config.block)
    order = order[within]
    values = {name: value[order] for name, value in values.items()}
    values["means"] = quantize.dequantize_positions(blocks, config.position_bits, config.block)
    values["quats"], values["scales"] = quantize.aligned(values["quats"], values["scales"])
    values["opacities"] = values["opacities"].clip(*_LOGITS)
    forms = {} if sensitivity is None else sensitivity.rows
    codecs: dict[str, Rotations | Transform] = {}
    for name, option in _STEPS.items():
        step = getattr(config, option)
        if name == "quats":
            codecs[name] = Rotations(step)
        elif name in values and values[name].size:
            codecs[name] = fit_transform(values[name], step, centred=name != "features_rest", form=forms.get(name))
    ordered = {name: torch.from_numpy(values[name]).reshape(gaussians[name].shape) for name in names}
    of_head = {} if sensitivity is None else sensitivity.head
    return ordered, Codecs(config, blocks, codecs, _fit_head(head, config.head_step, of_head))


def _fit_head(head: Mapping[str, Tensor], share: float, sensitivity: Mapping[str, Tensor]) -> HeadCodec | None:
    """Steps of a share of each output channel's largest weight, or, by a sensitivity, of the same total error."""
    # Steps in inverse proportion to the root of the sensitivity take the fewest bits for an error.
    if not head:
        return None
    weights = {name: _on_cpu(value) for name, value in head.items() if value.ndim > 1}
    rows = {name: quantize.weight_steps(value, share) for name, value in weights.items()}
    columns = {name: torch.ones(value.shape[1]) for name, value in weights.items()}
    mean = max((float(value.mean()) for value in sensitivity.values()), default=0.0)
    if weights.keys() != sensitivity.keys() or mean <= 0:
        return HeadCodec(rows, columns)
    error = target = 0.0
    for name, value in weights.items():
        # All of a layer's derivatives are zero where a later layer is, as in a head that was enabled just now.
        least = max(1e-3 * float(sensitivity[name].mean()), 1e-9 * mean)
        loss, count = sensitivity[name].clamp_min(least), value[0, 0].numel()
        target += count * float((loss * rows[name].double()[:, None] ** 2).sum())
        row, column = loss.mean(dim=1), loss.mean(dim=0) / loss.mean()
        rows[name], columns[name] = (_quarters(side.rsqrt()) for side in (row, column))
        error += count * float((loss * (rows[name][:, None] * columns[name]).double() ** 2).sum())
    factor = _quarters(torch.tensor((target / error) ** 0.5))
    for name, value in weights.items():
        # A derivative says nothing of changes as large as the weights: in an untrained head they all seem useless.
        rows[name] = torch.minimum(rows[name] * factor, _quarters(quantize.weight_steps(value, _LARGEST_SHARE)))
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
    bits = {}
    for name, codec in codecs.gaussians.items():
        values = gaussians[name]
        bits[name] = _of_rows(codec.coefficients(values.reshape(len(values), -1)))
    if codecs.head is not None and head:
        levels = [codecs.head.coefficients(name, value) for name, value in head.items() if value.ndim > 1]
        bits["head"] = torch.stack([_of_magnitudes(level.abs().mean(dim=1), level.shape[1]) for level in levels]).sum()
    return bits


def _of_rows(levels: Tensor) -> Tensor:
    """Bits of levels ``[N, C]``: the mean of each run, and the deviations from it."""
    n, width = levels.shape
    whole = n // _RUN * _RUN
    runs = [levels[:whole].reshape(-1, _RUN, width), levels[whole:].reshape(-1, max(n - whole, 1), width)]
    total = levels.new_zeros(())
    for run in runs:
        if run.numel():
            means = run.mean(dim=1, keepdim=True)
            deviations = (run - means).abs().mean(dim=1)
            total = total + _of_magnitudes(deviations, run.shape[1]) + _of_magnitudes(means.abs(), 1)
    return total


def _of_magnitudes(means: Tensor, count: int) -> Tensor:
    """Bits of groups of ``count`` levels with these mean magnitudes."""
    return count * torch.log1p(2 * math.e * means).sum() / math.log(2)
