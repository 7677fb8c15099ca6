"""Rules of prunes, and one prune to a share of a field."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch
from fields import normal_field
from torch import Tensor
from torch.optim import Optimizer

from sundae_ns.core.gaussians import sanitise
from sundae_ns.graph.graph import NeighborGraph
from sundae_ns.pruning.decision import Decision, decide
from sundae_ns.pruning.rule import PruneRule, band_rule, kept_count

draws = partial(PruneRule, selection="systematic")
PAPER = band_rule(PruneRule(signal="positions"), 0.5)
gaussians = normal_field


def train(params: Mapping[str, Tensor], optimizers: Mapping[str, Optimizer], steps: int = 1) -> float:
    """Train all values towards 1; the loss before the last step."""
    loss = torch.zeros(())
    for _ in range(steps):
        loss = torch.stack([(value - 1).square().sum() for value in params.values() if value.requires_grad]).sum()
        for optimizer in optimizers.values():
            optimizer.zero_grad()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
    return loss.item()


def decide_share(
    params: Mapping[str, Tensor],
    rule: PruneRule,
    share: float = 0.1,
    contribution: Tensor | None = None,
    graph: NeighborGraph | None = None,
) -> Decision:
    """The decision that keeps a share of the finite Gaussians; arguments as of :func:`decide`."""
    return decide(params, rule, kept_count(share, sanitise(params).gaussians.num_gaussians), contribution, graph)
