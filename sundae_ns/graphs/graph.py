"""The weighted neighbour graph of a Gaussian field."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from sundae_ns.graphs.bandwidth import BandwidthRule, bandwidth
from sundae_ns.graphs.neighbors import knn


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
        rule: how ``tau`` and ``sigma`` are computed from the distances; see :func:`sundae_ns.graphs.bandwidth`.
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
    if sigma > 0:
        # Divide before squaring: the square of a small distance could underflow.
        weights = (distances / sigma).square_().mul_(-0.5).exp_()
    else:
        weights = (distances == 0).to(distances.dtype)
    weights.masked_fill_(distances >= tau**0.5, 0)
    return NeighborGraph(neighbors.indices, weights, weights.sum(dim=1), tau, sigma)
