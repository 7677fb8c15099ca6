"""An estimate of the bits of a pack that has gradients, for training with the rate in the loss.

A number that has the distribution of Laplace with mean magnitude m, and is rounded, takes about log2(1 + 2 e m) bits.
The contexts of the entropy coder know the magnitude around a primitive, so m is measured in runs along the curve.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.storage.packing.codecs import Codecs

_RUN = 16
"""Neighbours on the curve whose levels share a mean and a magnitude."""


def estimated_bits(codecs: Codecs, field: Mapping[str, Tensor], head: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Bits of each attribute of a field, without positions, and of a head, which may be empty.

    The codecs are on the device of the field, whose primitives are in their order.
    """
    bits = {}
    for name, codec in codecs.field.items():
        values = field[name]
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
