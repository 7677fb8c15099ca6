"""Bandwidth of a graph: how far its edges reach (``tau``) and how fast their weights fall (``sigma``)."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.graphs.threads import for_each, slices

BandwidthRule = Literal["robust", "literal"]

CUTOFF = 3.0
"""Edges of the robust rule end at this many sigma, where the weight has fallen to exp(-4.5) = 0.011."""

SAMPLED = 2**16
"""Number of values that the selection on the CPU samples to narrow the range."""

CHUNK = 2**18
"""Number of values that a thread reads at a time: 1 MiB in float32."""


class Bandwidth(NamedTuple):
    """The parameters of the paper's edge weights ``W_ij = exp(-d^2 / (2 sigma^2))`` where ``d^2 < tau``."""

    tau: float
    """Threshold on the *squared* distance, squared scene units."""
    sigma: float
    """Width of the Gaussian, scene units."""


def bandwidth(
    distances: Tensor, rule: BandwidthRule = "robust", *, tau: float | None = None, sigma: float | None = None
) -> Bandwidth:
    """Choose ``tau`` and ``sigma`` from the distances to the nearest neighbours.

    - ``robust``: ``sigma`` is the median of all positive distances, ``tau = (3 sigma)^2``. The median scales with the
      scene. Clones (distance 0, left out) and far floaters do not move it. Half of all neighbours lie within one sigma, so
      weights spread over (0, 1); only primitives beyond three times the typical spacing have no edge.
    - ``literal``: the paper's words. ``tau`` is ten times the smallest nearest-neighbour distance, compared with squared
      distances as printed. ``sigma`` is the variance of the distances to the nearest neighbours, because the full matrix
      has N squared entries. The units do not match, and one pair of clones makes ``tau`` 0 and the graph empty. This rule
      is for comparison only.

    Without a positive distance (coincident points, or none) every width gives the same graph, and the robust sigma is 1.

    Args:
        distances: ascending neighbour distances in scene units ``[N, K]``; may be ``inf``.
        rule: gives the values that are not set.
        tau: replaces the rule's threshold, squared scene units.
        sigma: replaces the rule's width, scene units; the robust ``tau`` follows it.

    Raises:
        ConfigError: the rule is unknown, ``tau`` is negative or ``sigma`` is not positive.
    """
    if rule not in get_args(BandwidthRule):
        raise ConfigError(f"unknown bandwidth rule {rule!r}: use one of {', '.join(get_args(BandwidthRule))}")
    if tau is not None and not tau >= 0:
        raise ConfigError(f"tau is {tau}: use a squared distance of at least 0")
    if sigma is not None and not sigma > 0:
        raise ConfigError(f"sigma is {sigma}: use a positive distance")
    distances = distances.detach()
    if sigma is None:
        sigma = _robust_sigma(distances) if rule == "robust" else _variance(distances)
    if tau is None:
        reach = CUTOFF * sigma
        # A product, not a power: in Python a power that overflows raises, and a product becomes infinite.
        tau = reach * reach if rule == "robust" else _ten_times_smallest(distances)
    return Bandwidth(float(tau), float(sigma))


def _robust_sigma(distances: Tensor) -> float:
    """Median of the positive finite distances; the lower of the two middle values."""
    zeros = int((distances == 0).sum())
    positive = int(torch.isfinite(distances).sum()) - zeros
    if positive == 0:
        return 1.0
    return kth_smallest(distances, zeros + (positive - 1) // 2)


def kth_smallest(values: Tensor, k: int) -> float:
    """The value at place ``k`` in ascending order, from 0; values are not negative and may be ``inf``."""
    if values.dtype not in (torch.float32, torch.float64):
        values = values.float()
    if values.device.type == "cpu":
        return select_near_sample(np.ascontiguousarray(values.numpy()).reshape(-1), k)
    return select_by_bits(values, k)


def select_by_bits(values: Tensor, k: int) -> float:
    """:func:`kth_smallest` of float32 or float64 values by counting, which is fast on a GPU.

    The bits of a number that is not negative, read as an integer, grow with the number. Counting bit by bit needs one byte of
    scratch memory per value; a sort needs more than the values themselves.
    """
    integer, highest = (torch.int32, 30) if values.dtype == torch.float32 else (torch.int64, 62)
    bits = values.view(integer)
    found = torch.zeros((), dtype=integer, device=values.device)
    for bit in range(highest, -1, -1):
        larger = found + (1 << bit)
        found = torch.where((bits < larger).sum() <= k, larger, found)
    return float(found.view(values.dtype))


def select_near_sample(values: NDArray[np.floating], k: int) -> float:
    """:func:`kth_smallest` of values ``[M]`` on all threads of a CPU.

    A sample gives a range that should hold the value, and only the few values in that range are sorted. If the range misses
    the value, all values are sorted, so the result does not depend on the sample.
    """
    low, high = -np.inf, np.inf
    if len(values) > SAMPLED:
        sample = np.sort(values[np.random.default_rng(0).integers(len(values), size=SAMPLED)])
        place, margin = k / len(values) * SAMPLED, 4 * SAMPLED**0.5  # 8 standard deviations of the place
        low, high = sample[max(int(place - margin), 0)], sample[min(int(place + margin), SAMPLED - 1)]

    def count_and_collect(part: slice) -> tuple[int, NDArray[np.floating]]:
        chunk = values[part]
        return int(np.count_nonzero(chunk < low)), chunk[(chunk >= low) & (chunk <= high)]

    found = for_each(count_and_collect, slices(len(values), CHUNK))
    near, rank = np.concatenate([kept for _, kept in found]), k - sum(below for below, _ in found)
    if not 0 <= rank < len(near):
        near, rank = values, k
    return float(np.partition(near, rank)[rank])


def _variance(distances: Tensor) -> float:
    finite = _finite(distances)
    return float(finite.double().var(correction=0)) if finite.numel() else 0.0


def _ten_times_smallest(distances: Tensor) -> float:
    finite = _finite(distances)
    return 10.0 * float(finite.min()) if finite.numel() else 0.0


def _finite(distances: Tensor) -> Tensor:
    finite = torch.isfinite(distances)
    return distances if bool(finite.all()) else distances[finite]
