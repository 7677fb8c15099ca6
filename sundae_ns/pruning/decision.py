"""The decision which primitives of a field to keep. Pure: it changes nothing."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.gaussians.field import Field, as_field
from sundae_ns.gaussians.parameters import finite_mask, num_primitives
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.coverage import neighbor_order, select_systematic
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.redistribution import merged
from sundae_ns.pruning.scores import Contribution, for_graph, response, score
from sundae_ns.pruning.selection import select_band, select_random, select_sampled, select_top


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


@torch.no_grad()
def decide(
    params: Mapping[str, Tensor],
    config: PruningConfig,
    contribution: Contribution | None = None,
    *,
    count: int,
    graph: NeighborGraph | None = None,
) -> Decision:
    """Decide which primitives of a field to keep.

    Primitives with a NaN or infinite parameter are dropped first; of the others exactly ``count`` stay. If that is all of
    them, nothing is scored. In a field of at most ``num_neighbors`` primitives each is a neighbour of all others within
    reach.

    Args:
        params: the field.
        config: options; its keep ratio and schedule are not used.
        contribution: returns the summed blending weights of ``params`` over the training views ``[N]``; called only if
            needed.
        count: number of primitives to keep, at least 1; all finite primitives are kept if they are fewer.
        graph: :func:`field_graph` of the finite primitives by the same options; built if not given and needed.

    Raises:
        ConfigError: an option is invalid, or a contribution is needed and not given.
        DataError: no primitive is finite, or the contribution does not have one value per primitive.
    """
    config.validate()
    n = num_primitives(params)
    finite = finite_mask(params)
    n_finite = int(finite.sum())
    if n_finite == 0:
        raise DataError(
            f"none of {n} primitives is finite: the training has diverged, go back to an earlier checkpoint"
        )
    count = min(count, n_finite)
    if count == n_finite:
        return Decision(finite, n_finite, n - n_finite)

    field = as_field(params)
    usable = field if n_finite == n else field.rows(finite)
    weights = _once(contribution, finite)
    if not config.uses_graph:
        graph = None
    elif graph is None:
        graph = field_graph(for_graph(usable, config), config)
    magnitude = response(usable, config, graph) if config.uses_response else None
    values = score(usable, config, magnitude, weights)
    selected = _select(values, config, count, usable["means"])
    mask = finite.clone()
    mask[finite] = selected.to(mask.device)
    return Decision(
        mask=mask,
        kept=count,
        dropped_nonfinite=n - n_finite,
        tau=None if graph is None else graph.tau,
        sigma=None if graph is None else graph.sigma,
        isolated=None if graph is None else int(graph.isolated.sum()),
        values=_redistributed(usable, config, graph, selected, weights),
    )


def _redistributed(
    params: Field,
    config: PruningConfig,
    graph: NeighborGraph | None,
    mask: Tensor,
    weights: Contribution | None,
) -> dict[str, Tensor] | None:
    if config.redistribution == "none":
        return None
    assert graph is not None
    if weights is None:
        raise ConfigError("a merge needs a pass over the training views and there are none: set redistribution to none")
    return merged(params, graph, mask, weights())


def _select(values: Tensor, config: PruningConfig, count: int, points: Tensor) -> Tensor:
    if config.selection == "systematic":
        return select_systematic(values, count, neighbor_order(points), config.seed)
    if config.score == "random":
        return select_random(len(values), count, config.seed, values.device)
    if config.selection == "band":
        return select_band(values, count, config.gamma)
    if config.selection == "top":
        return select_top(values, count)
    return select_sampled(values, count, config.seed)


def _once(contribution: Contribution | None, finite: Tensor) -> Contribution | None:
    """The contribution of the finite primitives, computed at most once."""
    return None if contribution is None else functools.cache(lambda: _rows(contribution(), finite))


def _rows(contribution: Tensor, finite: Tensor) -> Tensor:
    if contribution.shape != finite.shape:
        raise DataError(
            f"contribution has shape {list(contribution.shape)} for {len(finite)} primitives: return [{len(finite)}]"
        )
    return contribution[finite.to(contribution.device)].to(finite.device)
