"""Fields for prunes, and one prune to a share of a field."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sundae_ns.core.gaussians import sanitise
from sundae_ns.graph.graph import NeighborGraph
from sundae_ns.pruning.decision import Decision, decide
from sundae_ns.pruning.rule import PruneRule, band_rule, kept_count

PAPER = band_rule(PruneRule(signal="positions"), 0.5)


def gaussians(n: int = 60, means: Tensor | None = None, *, seed: int = 0, features: int = 0) -> dict[str, Tensor]:
    """Normal parameters of degree 1, centres too unless they are given; with their dtype."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (3, 3)}
    shapes |= {"opacities": (1,)} | ({"features": (features,)} if features else {})
    n, dtype = (n, torch.float32) if means is None else (len(means), means.dtype)
    made = {name: torch.randn(n, *shape, generator=generator).to(dtype) for name, shape in shapes.items()}
    return made if means is None else {**made, "means": means}


def decide_share(
    params: Mapping[str, Tensor],
    rule: PruneRule,
    share: float = 0.1,
    contribution: Tensor | None = None,
    graph: NeighborGraph | None = None,
) -> Decision:
    """The decision that keeps a share of the finite Gaussians; arguments as of :func:`decide`."""
    return decide(params, rule, kept_count(share, sanitise(params).gaussians.num_gaussians), contribution, graph)
