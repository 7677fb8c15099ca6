"""The weighted neighbour graph: how far edges reach (``tau``), and how fast their weights fall (``sigma``)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from sundae_ns.graph.neighbors import knn

CUTOFF = 3.0  # edges end at this many sigma, where the weight has fallen to exp(-4.5) = 0.011
SAMPLED = 2**20  # most distances in the sample for the median


@dataclass(frozen=True, eq=False)
class NeighborGraph:
    """Rows of the weight matrix W, one per Gaussian, each with at most K entries.

    The graph is directed: ``i`` may be among the K nearest of ``j`` without ``j`` being among those of ``i``.
    """

    indices: Tensor  # Column indices of W, int64 [N, K]
    weights: Tensor  # Values of W in [0, 1], 0 where there is no edge [N, K]
    dw: Tensor  # Weighted degrees, the row sums of W [N]
    tau: float  # Edges join points whose squared distance is below this, squared scene units
    sigma: float  # Width of the Gaussian of the weights, scene units

    @property
    def N(self) -> int:
        """Number of nodes."""
        return self.indices.shape[0]

    @property
    def isolated(self) -> Tensor:
        """True for nodes without an edge, bool ``[N]``."""
        return self.dw == 0


def build_graph(points: Tensor, *, num_neighbors: int = 16) -> NeighborGraph:
    """Nearest-neighbour graph with Gaussian weights ``exp(-d^2 / (2 sigma^2))`` where ``d^2 < tau`` (paper, ``W_ij``).

    ``sigma`` is the median of the positive distances to neighbours, or 1 without any, and ``tau = (3 sigma)^2``. The
    median scales with the scene. Clones (distance 0, left out) and far floaters do not move it. Half of all neighbours
    lie within one sigma, so weights spread over (0, 1); only Gaussians beyond three times the typical spacing have no
    edge. The paper's rule (``tau`` ten times the smallest distance, ``sigma`` the variance of distances) mixes units,
    and leaves the graph empty if the field has a pair of clones. ``points`` ``[N, 3]`` have any floating dtype and
    device, which the graph gets. ``num_neighbors``, the most edges of a node, are at least 1, else a ``ConfigError``.
    ``DataError`` for as few points, or for some that are not finite.
    """
    indices, distances = knn(points, num_neighbors)
    sigma = _typical_distance(distances)
    reach = CUTOFF * sigma
    beyond = distances >= reach
    # Divide before squaring: the square of a small distance could underflow. In place: these are gigabytes.
    weights = distances.div_(sigma).square_().mul_(-0.5).exp_().masked_fill_(beyond, 0)
    return NeighborGraph(indices, weights, weights.sum(dim=1), reach * reach, sigma)


def _typical_distance(distances: Tensor) -> float:
    """Median of the positive finite distances ``[N, K]``, the lower of the two middle values; 1 without any."""
    # Of a large field every n-th Gaussian: on a GPU one block of threads finds the median, too slow for gigabytes.
    values = distances[:: max(1, distances.numel() // SAMPLED)]
    values = values[(values > 0) & values.isfinite()]
    return float(values.median()) if len(values) else 1.0
