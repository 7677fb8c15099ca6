"""One prune to the keep ratio of a configuration."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from sundae_ns.gaussians import finite_mask
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning import Decision, PruningConfig, decide, kept_count
from sundae_ns.pruning.scores import Contribution


def decide_share(
    params: Mapping[str, Tensor],
    config: PruningConfig,
    contribution: Contribution | None = None,
    graph: NeighborGraph | None = None,
) -> Decision:
    """The decision that keeps ``config.keep_ratio`` of the finite primitives; arguments as of :func:`decide`."""
    count = kept_count(config.keep_ratio, int(finite_mask(params).sum()))
    return decide(params, config, contribution, count=count, graph=graph)
