"""The decision: which primitives of a field stay. Pure; nothing is changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.gaussians.parameters import finite_mask, num_primitives
from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.scores import Contribution, Response, response, score
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


@torch.no_grad()
def decide(
    params: Mapping[str, Tensor],
    config: PruningConfig,
    contribution: Contribution | None = None,
    *,
    count: int | None = None,
    found: Response | None = None,
) -> Decision:
    """Decide which primitives of a field stay.

    Primitives with a NaN or infinite parameter go first; of the N that are left, exactly ``round(keep_ratio * N)``
    stay. Where that is all of them, nothing is scored.

    Args:
        params: the field.
        config: the options; see :class:`PruningConfig`.
        contribution: gives the blending weights over the training views, one per primitive of ``params`` ``[N]``;
            called only if the score needs it.
        count: keeps this many, or all if there are not so many, instead of the share.
        found: response of the finite primitives, where it is known already; else it is computed if the score needs it.

    Raises:
        ConfigError: an option cannot work, or the score needs a contribution and there is none.
        DataError: no primitive is finite, or the field has not more primitives than the graph has neighbours.
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
    found = (found or response(usable, config)) if config.uses_graph else None
    usable_contribution = None if contribution is None else lambda: _rows(contribution(), finite)
    selected = _select(score(usable, config, found, usable_contribution), config, count)
    mask = finite.clone()
    mask[finite] = selected
    return Decision(
        mask=mask,
        kept=count,
        dropped_nonfinite=n - n_finite,
        magnitude=None if found is None else _spread(found, finite),
        tau=None if found is None else found.tau,
        sigma=None if found is None else found.sigma,
        isolated=None if found is None else found.isolated,
    )


def _select(values: Tensor, config: PruningConfig, count: int) -> Tensor:
    if config.score == "random":
        return select_random(len(values), count, config.seed, values.device)
    if config.selection == "band":
        return select_band(values, count, config.gamma)
    if config.selection == "top":
        return select_top(values, count)
    return select_sampled(values, count, config.seed)


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
