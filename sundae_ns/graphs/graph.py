"""The weighted neighbour graph of a Gaussian field."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from sundae_ns.graphs.bandwidth import BandwidthRule, bandwidth
from sundae_ns.graphs.neighbors import Neighbors, knn


@dataclass(frozen=True, eq=False)
class NeighborGraph:
    """Rows of the weight matrix W, one per primitive, each with at most K entries.

    The graph is directed where ``i`` is among the K nearest of ``j`` but not the other way round;
    :func:`sundae_ns.graphs.adjacency` symmetrises it.
    """

    indices: Tensor
    """Column indices of W, int64 ``[N, K]``."""
    weights: Tensor
    """Values of W in [0, 1], 0 where there is no edge ``[N, K]``."""
    dw: Tensor
    """Weighted degree, the row sums of W ``[N]``."""
    tau: float
    """Edges join points with a squared distance below this, squared scene units."""
    sigma: float
    """Width of the Gaussian of the weights, scene units."""

    @property
    def N(self) -> int:
        """Number of nodes."""
        return self.indices.shape[0]

    @property
    def Ne(self) -> int:
        """Number of directed edges, that is of positive weights."""
        return int((self.weights > 0).sum())

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
        num_neighbors: most edges that leave a node; must be less than N.
        rule: how ``tau`` and ``sigma`` follow from the distances; see :func:`sundae_ns.graphs.bandwidth`.
        tau: replaces the rule's threshold, squared scene units.
        sigma: replaces the rule's width, scene units.

    Returns:
        A graph on the device and with the dtype of the points.

    Raises:
        ConfigError: an option is out of range.
        DataError: there are too few points, or some are not finite.
    """
    return graph_from_neighbors(knn(points, num_neighbors), rule=rule, tau=tau, sigma=sigma)


def graph_from_neighbors(
    neighbors: Neighbors,
    *,
    rule: BandwidthRule = "robust",
    tau: float | None = None,
    sigma: float | None = None,
) -> NeighborGraph:
    """Weigh the edges of a finished neighbour search; arguments as in :func:`build_graph`."""
    distances = neighbors.distances
    tau, sigma = bandwidth(distances, rule, tau=tau, sigma=sigma)
    if sigma > 0:
        # Divided before it is squared: the square of a small distance could underflow.
        weights = (distances / sigma).square_().mul_(-0.5).exp_()
    else:
        weights = (distances == 0).to(distances.dtype)
    weights.masked_fill_(distances >= tau**0.5, 0)
    return NeighborGraph(neighbors.indices, weights, weights.sum(dim=1), tau, sigma)
