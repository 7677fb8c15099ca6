"""The decision which Gaussians of a field to keep, and its two uses: a new field, and a field in training."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.gaussians import Gaussians, as_gaussians, num_gaussians, sanitise
from sundae_ns.core.surgery import grow, keep, per_gaussian, rewrite
from sundae_ns.graph.graph import NeighborGraph
from sundae_ns.pruning.merge import gaussian_graph, merged, pair_labels
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.pruning.scores import score
from sundae_ns.pruning.selection import neighbor_order, select_band, select_systematic


@dataclass(frozen=True, eq=False)
class Decision:
    """Which Gaussians to keep, and the figures behind the choice."""

    mask: Tensor  # True for Gaussians to keep, bool [N]
    kept: int  # Number of Gaussians that the mask keeps
    dropped_nonfinite: int  # Number of Gaussians dropped because a parameter is NaN or infinite
    tau: float | None = None  # Threshold of the graph on squared distances, squared scene units; None without a graph
    sigma: float | None = None  # Width of the graph's weights, scene units; None if no graph was needed
    isolated: int | None = None  # Number of Gaussians without a neighbour within the threshold; None without a graph
    values: Mapping[str, Tensor] | None = None  # New parameters of the kept Gaussians [kept, ...]; None if unchanged


class Pruned(NamedTuple):
    """A pruned field, and the decision behind it."""

    gaussians: Gaussians  # The kept Gaussians, merged with the dropped ones if the rule merges; tensors of its own
    decision: Decision  # Mask over the field before the prune, and figures


@torch.no_grad()
def prune_gaussians(
    gaussians: Mapping[str, Tensor],
    rule: PruneRule,
    count: int,
    contribution: Tensor | None = None,
    graph: NeighborGraph | None = None,
) -> Pruned:
    """Prune a field to ``count`` Gaussians; arguments and errors are those of :func:`decide`."""
    decision = decide(gaussians, rule, count, contribution, graph)
    return Pruned(as_gaussians(gaussians).rows(decision.mask).replaced(decision.values or {}), decision)


@torch.no_grad()
def decide(
    params: Mapping[str, Tensor],
    rule: PruneRule,
    count: int,
    contribution: Tensor | None = None,
    graph: NeighborGraph | None = None,
) -> Decision:
    """Decide which Gaussians of a field to keep: exactly ``count``, or all finite ones if they are fewer.

    Gaussians without a meaning go first (``gaussians.sanitise``); if all others stay, nothing is scored. A rule that
    ``uses_contribution`` needs one ``[N]``, by :func:`sundae_ns.scene.render.contribution`; ``graph`` is built if not
    given. ``ConfigError`` for an invalid option or without a contribution, ``DataError`` for a ``count`` below 1, or
    without a finite Gaussian.
    """
    rule.validate()
    sanitised = sanitise(params)
    usable, finite = sanitised.gaussians, sanitised.mask
    n, n_finite = len(finite), usable.num_gaussians
    if n_finite == 0:
        raise diverged(n)
    if count < 1:
        raise DataError(f"cannot keep {count} of {n_finite} Gaussians: ask for 1 to {n_finite}")
    if count >= n_finite:
        return Decision(finite, n_finite, n - n_finite, values=dict(usable) if sanitised.clamped else None)

    if contribution is not None:
        if contribution.shape != finite.shape:
            raise DataError(f"contribution has shape {list(contribution.shape)} for {n} Gaussians: return [{n}]")
        contribution = contribution.detach()[finite.to(contribution.device)].to(finite.device)
    graph = (graph or gaussian_graph(usable, rule)) if rule.uses_graph else None
    scores = score(usable, rule, graph, contribution)
    labels = None
    if rule.selection == "pairs":
        assert graph is not None
        labels = pair_labels(usable, graph, scores, count)
        selected = labels == torch.arange(n_finite, device=labels.device)
    elif rule.selection == "band":
        selected = select_band(scores, count, rule.gamma)
    else:
        selected = select_systematic(scores, count, neighbor_order(usable["means"]), rule.seed)
    mask = finite.clone()
    mask[finite] = selected.to(mask.device)
    values = dict(usable.rows(selected.to(finite.device))) if sanitised.clamped else None
    if rule.redistribution == "merge":
        assert graph is not None
        if contribution is None:
            raise ConfigError("a merge needs a pass over the training views: give views, or set redistribution to none")
        values = merged(usable, graph, selected, contribution, labels)
    if graph is None:
        return Decision(mask, count, n - n_finite, values=values)
    return Decision(mask, count, n - n_finite, graph.tau, graph.sigma, int(graph.isolated.sum()), values)


def diverged(n: int) -> DataError:
    """The error for a field of ``n`` Gaussians without a finite one."""
    if n == 0:
        return DataError(
            "no Gaussian is left: all became transparent and were removed, as where images show only their "
            "background; check the images, their masks and --pipeline.model.background-color"
        )
    return DataError(f"none of {n} Gaussians is finite: the training has diverged, go back to an earlier checkpoint")


@dataclass(eq=False)
class Pruner:
    """Prunes a field in place, with its optimizers and running states."""

    params: MutableMapping[str, Parameter]  # The field, name to parameter [N, ...]; its parameters are replaced
    optimizers: Mapping[str, Optimizer]  # By parameter name, one parameter each; others are left alone
    states: Sequence[MutableMapping[str, Any]] = ()  # Running states; their tensors of N rows are sliced along

    @property
    def total(self) -> int:
        """Number of Gaussians."""
        return num_gaussians(self.params)

    def drop_nonfinite(self) -> int:
        """Remove Gaussians that are not finite, clamp others (``sanitise``); returns how many went.

        Call it before a pass over images, in which one NaN spreads. ``DataError`` if all would go.
        """
        sanitised = sanitise(self.params)
        if not sanitised.gaussians.num_gaussians:
            raise diverged(sanitised.dropped)
        if sanitised.dropped:
            keep(self.params, self.optimizers, self.states, sanitised.mask)
        if sanitised.clamped:
            rewrite(self.params, self.optimizers, sanitised.gaussians)
        return sanitised.dropped

    def drop(self, mask: Tensor, *, at_most: float) -> int:
        """Remove the Gaussians under a mask, bool ``[N]``, unless more than ``at_most`` of all; returns how many."""
        if not 0 < (count := int(mask.sum())) <= at_most * self.total:
            return 0
        keep(self.params, self.optimizers, self.states, ~mask)
        return count

    @torch.no_grad()
    def cut(self, rule: PruneRule, count: int, contribution: Tensor | None = None) -> Decision:
        """Decide, remove and merge; see :func:`sundae_ns.pruning.decision.decide` for arguments and errors."""
        decision = decide(self.params, rule, count, contribution)
        keep(self.params, self.optimizers, self.states, decision.mask)
        if decision.values is not None:
            rewrite(self.params, self.optimizers, decision.values)
        return decision

    def add(self, count: int, least_opacity: float) -> None:
        """Add ``count`` Gaussians on top of others, which share their opacity; statistics of densification go."""
        n = self.total
        grow(self.params, self.optimizers, count, least_opacity)
        for state in self.states:
            state.update(dict.fromkeys(name for name, value in state.items() if per_gaussian(value, n)))
