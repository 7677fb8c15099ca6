"""The prune itself, for those who decide when one is due: the policies, and the search for a budget."""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.gaussians.parameters import finite_mask
from sundae_ns.gaussians.rewriting import rewrite
from sundae_ns.gaussians.surgery import keep, keep_state
from sundae_ns.pruning.config import PruningConfig
from sundae_ns.pruning.decision import Decision, decide
from sundae_ns.pruning.scores import Contribution


def drop_nonfinite(
    params: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    state: MutableMapping[str, Any],
    strategy_state: MutableMapping[str, Any] | None = None,
) -> int:
    """Remove the primitives with a NaN or infinite parameter, in place; arguments are those of :func:`cut`.

    Returns:
        How many these were; 0 where no other is left, which leaves the field as it is.
    """
    finite = finite_mask(params)
    dropped = int((~finite).sum())
    if dropped == len(finite):
        return 0
    if dropped:
        _keep(params, optimizers, state, strategy_state, finite)
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
    count: Callable[[int], int | None],
    strategy_state: MutableMapping[str, Any] | None = None,
) -> Decision:
    """Prune a field in training, in place: drop what is not finite, decide, remove the others, hand on what they had.

    Args:
        params: the field; its parameters are replaced.
        optimizers: optimizers by parameter name; others are left alone.
        state: running state of a policy; says afterwards that a prune happened.
        config: the options of this prune.
        contribution: gives the summed blending weights over the training views for ``params`` as they are when it is
            called, which is after NaN and infinite primitives have gone ``[N]``; called only if it is needed.
        step: of the schedule, which has just ended.
        count: of so many finite primitives, how many stay; None for the keep ratio.
        strategy_state: state of a densification strategy on the same primitives; sliced with them.

    Returns:
        What was decided; ``mask`` and ``magnitude`` are of the finite primitives.

    Raises:
        ConfigError, DataError: see :func:`sundae_ns.pruning.decide`.
    """
    # Before the decision: the contribution is a render of the field, and one NaN spoils all of its pixels.
    dropped = drop_nonfinite(params, optimizers, state, strategy_state)
    decision = decide(params, config, contribution, count=count(len(params["means"])))
    _keep(params, optimizers, state, strategy_state, decision.mask)
    if decision.values is not None:
        rewrite(params, optimizers, decision.values)
    state["pruned_at"] = step
    state["num_prunes"] += 1
    return replace(decision, dropped_nonfinite=dropped)


def _keep(
    params: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    state: MutableMapping[str, Any],
    strategy_state: MutableMapping[str, Any] | None,
    mask: Tensor,
) -> None:
    keep(params, optimizers, state, mask)
    if strategy_state is not None:
        keep_state(strategy_state, mask)
