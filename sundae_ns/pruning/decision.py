"""The decision which primitives of a field to keep, and the field that it leaves. Both change nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.gaussians.field import Field, as_field
from sundae_ns.gaussians.mending import mend
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.pairing import pair_labels
from sundae_ns.pruning.redistribution import merged
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.pruning.scores import response, score
from sundae_ns.pruning.selection import neighbor_order, select_band, select_sampled, select_systematic, select_top


@dataclass(frozen=True, eq=False)
class Decision:
    """Which primitives to keep, and the figures behind the choice."""

    mask: Tensor
    """True for primitives to keep, bool ``[N]``."""
    kept: int
    """Number of primitives that the mask keeps."""
    dropped_nonfinite: int
    """Number of primitives dropped because a parameter is NaN or infinite."""
    tau: float | None = None
    """Threshold of the graph on squared distances, squared scene units; None if no graph was needed."""
    sigma: float | None = None
    """Width of the graph's weights, scene units; None if no graph was needed."""
    isolated: int | None = None
    """Number of primitives without a neighbour within the threshold; None if no graph was needed."""
    values: Mapping[str, Tensor] | None = None
    """New parameters of the kept primitives, in order ``[kept, ...]``; None if they are unchanged."""


class Pruned(NamedTuple):
    """A pruned field, and the decision behind it."""

    field: Field
    """The kept primitives, merged with the dropped ones if the rule merges; tensors of its own."""
    decision: Decision
    """Mask over the field before the prune, and figures."""


@torch.no_grad()
def prune_field(
    field: Mapping[str, Tensor],
    rule: PruneRule,
    count: int,
    contribution: Tensor | None = None,
    graph: NeighborGraph | None = None,
) -> Pruned:
    """Prune a field to ``count`` primitives; arguments and errors are those of :func:`decide`."""
    decision = decide(field, rule, count, contribution, graph)
    return Pruned(as_field(field).rows(decision.mask).replaced(decision.values or {}), decision)


@torch.no_grad()
def decide(
    params: Mapping[str, Tensor],
    rule: PruneRule,
    count: int,
    contribution: Tensor | None = None,
    graph: NeighborGraph | None = None,
) -> Decision:
    """Decide which primitives of a field to keep.

    Primitives with a NaN, or an infinite parameter without a meaning, are dropped first (``gaussians.mend``); of the
    others exactly ``count`` stay. If that is all of them, nothing is scored. In a field of at most ``num_neighbors``
    primitives each is a neighbour of all others within reach.

    Args:
        params: the field, N primitives.
        rule: how to score, select and merge.
        count: number of primitives to keep, at least 1; all finite primitives are kept if they are fewer.
        contribution: blending weights, summed over the training views, any device ``[N]``; see
            :func:`sundae_ns.rendering.contribution`. Needed if ``rule.uses_contribution``.
        graph: :func:`field_graph` of the finite primitives by the same rule; built if not given and needed.

    Raises:
        ConfigError: an option is invalid, or a contribution is needed and not given.
        DataError: no primitive is finite, or the contribution does not have one value per primitive.
    """
    rule.validate()
    mended = mend(params)
    usable, finite = mended.field, mended.mask
    n, n_finite = len(finite), usable.num_primitives
    if n_finite == 0:
        raise diverged(n)
    count = min(count, n_finite)
    if count == n_finite:
        return Decision(finite, n_finite, n - n_finite, values=dict(usable) if mended.clamped else None)

    if contribution is not None:
        if contribution.shape != finite.shape:
            raise DataError(f"contribution has shape {list(contribution.shape)} for {n} primitives: return [{n}]")
        contribution = contribution.detach()[finite.to(contribution.device)].to(finite.device)
    if not rule.uses_graph:
        graph = None
    elif graph is None:
        graph = field_graph(usable, rule)
    magnitude = response(usable, rule, graph) if rule.uses_response else None
    scores, labels = score(usable, rule, magnitude, contribution), None
    if rule.selection == "pairs":
        assert graph is not None
        labels = pair_labels(usable, graph, scores, count)
        selected = labels == torch.arange(n_finite, device=labels.device)
    else:
        selected = _select(scores, rule, count, usable["means"])
    mask = finite.clone()
    mask[finite] = selected.to(mask.device)
    values = dict(usable.rows(selected.to(finite.device))) if mended.clamped else None
    if rule.redistribution == "merge":
        assert graph is not None
        if contribution is None:
            raise ConfigError(
                "a merge needs a pass over the training views and there are none: set redistribution to none"
            )
        values = merged(usable, graph, selected, contribution, labels)
    return Decision(
        mask=mask,
        kept=count,
        dropped_nonfinite=n - n_finite,
        tau=None if graph is None else graph.tau,
        sigma=None if graph is None else graph.sigma,
        isolated=None if graph is None else int(graph.isolated.sum()),
        values=values,
    )


def _select(values: Tensor, rule: PruneRule, count: int, points: Tensor) -> Tensor:
    if rule.selection == "systematic":
        return select_systematic(values, count, neighbor_order(points), rule.seed)
    # Equal scores have no ends to take from.
    if rule.selection == "sampled" or rule.score == "random":
        return select_sampled(values, count, rule.seed)
    return select_band(values, count, rule.gamma) if rule.selection == "band" else select_top(values, count)


def diverged(n: int) -> DataError:
    """The error for a field of ``n`` primitives without a finite one."""
    if n == 0:
        return DataError(
            "no primitive is left: all became transparent and were removed, as where images show only their "
            "background; check the images, their masks and --pipeline.model.background-color"
        )
    return DataError(f"none of {n} primitives is finite: the training has diverged, go back to an earlier checkpoint")
