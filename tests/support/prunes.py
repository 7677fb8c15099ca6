"""One prune to a share of a field."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from sundae_ns.gaussians import mend
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning import Decision, PruneRule, decide, kept_count


def decide_share(
    params: Mapping[str, Tensor],
    rule: PruneRule,
    share: float = 0.1,
    contribution: Tensor | None = None,
    graph: NeighborGraph | None = None,
) -> Decision:
    """The decision that keeps a share of the finite primitives; arguments as of :func:`decide`."""
    return decide(params, rule, kept_count(share, mend(params).field.num_primitives), contribution, graph)
