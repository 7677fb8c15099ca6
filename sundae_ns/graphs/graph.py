"""The weighted neighbour graph: how far edges reach (``tau``), and how fast their weights fall (``sigma``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.graphs.neighbors import knn

BandwidthRule = Literal["robust", "literal"]

CUTOFF = 3.0
"""Edges of the robust rule end at this many sigma, where the weight has fallen to exp(-4.5) = 0.011."""

SAMPLED = 2**16
"""Number of values that the selection samples to narrow the range."""


class Bandwidth(NamedTuple):
    """The parameters of the paper's edge weights ``W_ij = exp(-d^2 / (2 sigma^2))`` where ``d^2 < tau``."""

    tau: float
    """Threshold on the *squared* distance, squared scene units."""
    sigma: float
    """Width of the Gaussian, scene units."""


@dataclass(frozen=True, eq=False)
class NeighborGraph:
    """Rows of the weight matrix W, one per primitive, each with at most K entries.

    The graph is directed: ``i`` may be among the K nearest of ``j`` without ``j`` being among those of ``i``.
    """

    indices: Tensor
    """Column indices of W, int64 ``[N, K]``."""
    weights: Tensor
    """Values of W in [0, 1], 0 where there is no edge ``[N, K]``."""
    dw: Tensor
    """Weighted degrees, the row sums of W ``[N]``."""
    tau: float
    """Edges join points whose squared distance is below this, squared scene units."""
    sigma: float
    """Width of the Gaussian of the weights, scene units."""

    @property
    def N(self) -> int:
        """Number of nodes."""
        return self.indices.shape[0]

    @property
    def isolated(self) -> Tensor:
        """True for nodes without an edge, bool ``[N]``."""
        return self.dw == 0


def build_graph(
    points: Tensor,
    *,
    num_neighbors: int = 16,
    rule: BandwidthRule = "robust",
    tau: float | None = None,
    sigma: float | None = None,
) -> NeighborGraph:
    """Nearest-neighbour graph with Gaussian weights (paper, equation ``W_ij``).

    Args:
        points: centres in scene units, any floating dtype and device ``[N, 3]``.
        num_neighbors: most edges of a node; must be less than N.
        rule: how ``tau`` and ``sigma`` are computed from the distances; see :func:`bandwidth`.
        tau: replaces the rule's threshold, squared scene units.
        sigma: replaces the rule's width, scene units.

    Returns:
        A graph on the device and with the dtype of the points.

    Raises:
        ConfigError: an option is out of range.
        DataError: too few points, or points that are not finite.
    """
    neighbors = knn(points, num_neighbors)
    distances = neighbors.distances
    tau, sigma = bandwidth(distances, rule, tau=tau, sigma=sigma)
    beyond = distances >= tau**0.5
    if sigma > 0:
        # Divide before squaring: the square of a small distance could underflow. In place: these are gigabytes.
        weights = distances.div_(sigma).square_().mul_(-0.5).exp_()
    else:
        weights = (distances == 0).to(distances.dtype)
    weights.masked_fill_(beyond, 0)
    return NeighborGraph(neighbors.indices, weights, weights.sum(dim=1), tau, sigma)


def bandwidth(
    distances: Tensor, rule: BandwidthRule = "robust", *, tau: float | None = None, sigma: float | None = None
) -> Bandwidth:
    """Choose ``tau`` and ``sigma`` from the distances to the nearest neighbours.

    - ``robust``: ``sigma`` is the median of all positive distances, ``tau = (3 sigma)^2``. The median scales with the
      scene. Clones (distance 0, left out) and far floaters do not move it. Half of all neighbours lie within one sigma,
      so weights spread over (0, 1); only primitives beyond three times the typical spacing have no edge.
    - ``literal``: the paper's words. ``tau`` is ten times the smallest nearest-neighbour distance, compared with
      squared distances as printed. ``sigma`` is the variance of the distances to the nearest neighbours, because the
      full matrix has N squared entries. The units do not match, and one pair of clones makes ``tau`` 0 and the graph
      empty. This rule is for comparison only.

    Without a positive distance (coincident points, or none) every width gives the same graph, and the robust sigma
    is 1.

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
    if rule == "robust":
        sigma = _robust_sigma(distances) if sigma is None else sigma
        reach = CUTOFF * sigma
        # A product, not a power: in Python a power that overflows raises, and a product becomes infinite.
        return Bandwidth(reach * reach if tau is None else float(tau), float(sigma))
    finite = distances[torch.isfinite(distances)]
    if sigma is None:
        sigma = float(finite.double().var(correction=0)) if finite.numel() else 0.0
    if tau is None:
        tau = 10.0 * float(finite.min()) if finite.numel() else 0.0
    return Bandwidth(float(tau), float(sigma))


def _robust_sigma(distances: Tensor) -> float:
    """Median of the positive finite distances; the lower of the two middle values."""
    zeros = int((distances == 0).sum())
    positive = int(torch.isfinite(distances).sum()) - zeros
    if positive == 0:
        return 1.0
    return kth_smallest(distances, zeros + (positive - 1) // 2)


def kth_smallest(values: Tensor, k: int) -> float:
    """The value at place ``k`` in ascending order, from 0; values are not negative and may be ``inf``.

    A sample gives a range that should hold the value, and only the few values in that range are sorted. If the range
    misses the value, all values are sorted, so the result does not depend on the sample.
    """
    values = values.flatten()
    if len(values) > SAMPLED:
        places = torch.randint(len(values), (SAMPLED,), generator=torch.Generator().manual_seed(0))
        sample = values[places.to(values.device)].sort().values
        place, margin = k / len(values) * SAMPLED, 4 * SAMPLED**0.5  # 8 standard deviations of the place
        low, high = sample[max(int(place - margin), 0)], sample[min(int(place + margin), SAMPLED - 1)]
        near, rank = values[(values >= low) & (values <= high)], k - int((values < low).sum())
        if 0 <= rank < len(near):
            return float(near.sort().values[rank])
    return float(values.sort().values[k])
