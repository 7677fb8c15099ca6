"""The decision: which primitives of a field stay. Pure; nothing is changed."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.gaussians.parameters import finite_mask, num_primitives
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.coverage import band_shares, neighbor_order, select_systematic
from sundae_ns.pruning.edges import field_graph
from sundae_ns.pruning.redistribution import grown, merged
from sundae_ns.pruning.scores import Contribution, Response, coherence, for_graph, response, score
from sundae_ns.pruning.selection import kept_count, select_band, select_random, select_sampled, select_top


@dataclass(frozen=True, eq=False)
class Decision:
    """Which primitives stay, and what the choice rests on."""

    mask: Tensor
    """True for primitives to keep, bool ``[N]``."""
    kept: int
    """How many primitives the mask keeps."""
    dropped_nonfinite: int
    """How many primitives go because a parameter of theirs is NaN or infinite; they do not count towards N."""
    magnitude: Tensor | None
    """Response magnitude ``[N]``, NaN where undefined; None if no graph was needed."""
    tau: float | None
    """Threshold of the graph on squared distances, squared scene units; None if no graph was needed."""
    sigma: float | None
    """Width of the graph's weights, scene units; None if no graph was needed."""
    isolated: int | None
    """How many primitives have no neighbour within the threshold; None if no graph was needed."""
    values: Mapping[str, Tensor] | None = None
    """What the parameters of those that stay become, in order ``[kept, ...]``; None where they stay as they are."""


@torch.no_grad()
def decide(
    params: Mapping[str, Tensor],
    config: PruningConfig,
    contribution: Contribution | None = None,
    *,
    count: int | None = None,
    graph: NeighborGraph | None = None,
) -> Decision:
    """Decide which primitives of a field stay.

    Primitives with a NaN or infinite parameter go first; of the N that are left, exactly ``round(keep_ratio * N)``
    stay. Where that is all of them, nothing is scored, so that one primitive always stays. A field of no more primitives
    than ``num_neighbors`` is pruned like any other: each is a neighbour of all others within reach.

    Args:
        params: the field.
        config: the options; see :class:`PruningConfig`.
        contribution: gives the blending weights over the training views, one per primitive of ``params`` ``[N]``;
            called only if the score needs it.
        count: keeps this many, or all if there are not so many, instead of the share.
        graph: :func:`field_graph` of the finite primitives by the same options, where it is at hand.

    Raises:
        ConfigError: an option cannot work, or the score needs a contribution and there is none.
        DataError: no primitive is finite, or the contribution has not one value a primitive.
    """
    config.validate()
    n = num_primitives(params)
    finite = finite_mask(params)
    n_finite = int(finite.sum())
    if n_finite == 0:
        raise DataError(
            f"none of {n} primitives is finite: the training has diverged, go back to an earlier checkpoint"
        )
    count = kept_count(config.keep_ratio, n_finite) if count is None else min(count, n_finite)
    if count == n_finite:
        return Decision(finite, n_finite, n - n_finite, None, None, None, None)

    usable = params if n_finite == n else {name: value.detach()[finite] for name, value in params.items()}
    weights = _once(contribution, finite)
    if not config.uses_graph:
        graph = None
    elif graph is None:
        graph = field_graph(for_graph(usable, config), config)
    found = response(usable, config, graph) if config.uses_response else None
    coherent = coherence(graph, count, config, finite.device) if graph is not None and config.uses_coherence else None
    values = score(usable, config, found, weights, coherent)
    selected = _select(values, config, count, found, usable["means"])
    mask = finite.clone()
    mask[finite] = selected.to(mask.device)
    return Decision(
        mask=mask,
        kept=count,
        dropped_nonfinite=n - n_finite,
        magnitude=None if found is None else _spread(found, finite),
        tau=None if graph is None else graph.tau,
        sigma=None if graph is None else graph.sigma,
        isolated=None if graph is None else int(graph.isolated.sum()),
        values=_redistributed(usable, config, graph, selected, weights),
    )


def _redistributed(
    params: Mapping[str, Tensor],
    config: PruningConfig,
    graph: NeighborGraph | None,
    mask: Tensor,
    weights: Contribution | None,
) -> dict[str, Tensor] | None:
    if config.redistribution == "none":
        return None
    if config.redistribution == "grow":
        return grown(params, mask)
    assert graph is not None
    if weights is None:
        raise ConfigError("a merge needs a pass over the training views and there are none: set redistribution to grow")
    return merged(params, graph, mask, weights(), logits=config.logits)


def _select(values: Tensor, config: PruningConfig, count: int, found: Response | None, points: Tensor) -> Tensor:
    if config.selection in ("systematic", "shared"):
        order = neighbor_order(points)
        if config.selection == "shared":
            assert found is not None
            values, band = band_shares(values, found.magnitude.sqrt())
            order = order[torch.sort(band[order], stable=True).indices]
        return select_systematic(values, count, order, config.seed)
    if config.score == "random":
        return select_random(len(values), count, config.seed, values.device)
    if config.selection == "band":
        return select_band(values, count, config.gamma)
    if config.selection == "top":
        return select_top(values, count)
    return select_sampled(values, count, config.seed)


def _once(contribution: Contribution | None, finite: Tensor) -> Contribution | None:
    """The contribution of the finite primitives, asked for once however often it is needed."""
    return None if contribution is None else functools.cache(lambda: _rows(contribution(), finite))


def _rows(contribution: Tensor, finite: Tensor) -> Tensor:
    if contribution.shape != finite.shape:
        raise DataError(
            f"contribution has shape {list(contribution.shape)} for {len(finite)} primitives: return [{len(finite)}]"
        )
    return contribution[finite.to(contribution.device)].to(finite.device)


def _spread(found: Response, finite: Tensor) -> Tensor:
    """Magnitudes of the finite primitives at their places among all ``[N]``."""
    magnitude = found.magnitude.new_full(finite.shape, torch.nan)
    magnitude[finite] = found.magnitude
    return magnitude
