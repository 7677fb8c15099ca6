"""Pruning of a field in training: what schedules and the budget search call when a prune is due."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, MutableMapping
from dataclasses import replace
from typing import Any

import torch
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.gaussians.parameters import finite_mask
from sundae_ns.gaussians.surgery import keep, rewrite
from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.decision import Decision, decide
from sundae_ns.pruning.scores import Contribution


def drop_nonfinite(
    params: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    states: Iterable[MutableMapping[str, Any]],
) -> int:
    """Remove the primitives with a NaN or infinite parameter, in place; see :func:`sundae_ns.gaussians.surgery.keep`.

    Returns:
        Number of removed primitives. If no primitive is finite, it is 0 and the field is unchanged.
    """
    finite = finite_mask(params)
    dropped = int((~finite).sum())
    if dropped == len(finite):
        return 0
    if dropped:
        keep(params, optimizers, states, finite)
    return dropped


@torch.no_grad()
def cut(
    params: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    state: MutableMapping[str, Any],
    config: PruningConfig,
    contribution: Contribution | None = None,
    *,
    step: int,
    count: Callable[[int], int],
    strategy_state: MutableMapping[str, Any] | None = None,
) -> Decision:
    """Prune a field in training, in place: drop primitives that are not finite, decide, remove, and merge.

    Args:
        params, optimizers: see :func:`sundae_ns.gaussians.surgery.keep`.
        state: running state of a schedule; the prune is recorded in it.
        config: options of this prune.
        contribution: returns the summed blending weights of ``params`` over the training views ``[N]``; called only if
            needed, after primitives that are not finite have been removed.
        step: step of the schedule that has just ended.
        count: maps the number of finite primitives to the number to keep.
        strategy_state: state of a densification strategy on the same primitives; sliced with them.

    Returns:
        The decision; its mask is over the finite primitives.

    Raises:
        ConfigError, DataError: see :func:`sundae_ns.pruning.decide`.
    """
    # Before the decision: the contribution renders the field, and one NaN spreads over the image.
    states = [state] if strategy_state is None else [state, strategy_state]
    dropped = drop_nonfinite(params, optimizers, states)
    decision = decide(params, config, contribution, count=count(len(params["means"])))
    keep(params, optimizers, states, decision.mask)
    if decision.values is not None:
        rewrite(params, optimizers, decision.values)
    state["pruned_at"] = step
    state["num_prunes"] += 1
    return replace(decision, dropped_nonfinite=dropped)
