"""One prune for all ranks: the whole field is gathered and judged in one place, and every rank drops its part."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.distributed.shards import Shards
from sundae_ns.errors import DataError, SundaeError
from sundae_ns.gaussians.parameters import finite_mask, num_primitives
from sundae_ns.gaussians.rewriting import rewrite
from sundae_ns.pruning import PruningConfig
from sundae_ns.pruning.scores import Contribution
from sundae_ns.training.report import PruneReport
from sundae_ns.training.schedules import PruningPolicy


@dataclass(frozen=True)
class GlobalPruning:
    """A pruning policy over the shards of one field: what one process decides for the whole field, all ranks do."""

    policy: PruningPolicy
    shards: Shards

    @property
    def config(self) -> PruningConfig:
        """Options of the policy."""
        return self.policy.config

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Whether the field is to be pruned after this step."""
        return self.policy.due(state, step, n)

    @torch.no_grad()
    def step_post_backward(
        self,
        params: MutableMapping[str, Parameter],
        optimizers: Mapping[str, Optimizer],
        state: MutableMapping[str, Any],
        step: int,
        info: Mapping[str, Any] | None = None,
        *,
        contribution: Contribution | None = None,
        strategy_state: MutableMapping[str, Any] | None = None,
    ) -> PruneReport | None:
        """Prune if it is due; arguments and errors as of the policy's own, for this rank's primitives. Collective."""
        shards, before = self.shards, self.shards.total
        state["peak"] = max(state["peak"], before)
        if not self.policy.due(state, step, before):
            return None
        for held in params.values():
            held.grad = None  # surgery would drop it, but only after the ranks have made room for the whole field
        states = [] if strategy_state is None else [strategy_state]
        finite = finite_mask(params)
        dropped = before - sum(count for (count,) in shards.numbers(int(finite.sum())))
        if dropped == before:
            raise DataError(
                f"none of {before} primitives is finite: the training has diverged, go back to an earlier checkpoint"
            )
        if dropped:
            shards.level(params, optimizers, states, finite)
        needed = contribution is not None and self.config.uses_contribution and self.config.keep_ratio < 1
        sums = shards.gather(contribution()) if contribution is not None and needed else None
        whole = {name: shards.gather(value) for name, value in params.items()}

        outcome: Any = None
        rows = torch.empty(0, dtype=torch.bool, device=shards.device)
        if shards.rank == 0:
            outcome, whole, rows = _decide(self.policy, whole, state, step, sums)
        outcome = shards.announce(outcome)
        if isinstance(outcome, SundaeError):
            raise outcome
        report, counted, changed = outcome
        state.update(counted)

        mask = torch.zeros(shards.total, dtype=torch.bool, device=shards.device)
        if shards.rank == 0:
            mask[rows] = True
        dist.broadcast(mask, 0)
        start = sum(shards.counts[: shards.rank])
        shards.level(params, optimizers, states, mask[start : start + num_primitives(params)])
        start = sum(shards.counts[: shards.rank])
        values = {}
        for name in changed:
            value = params[name].new_empty(shards.total, *params[name].shape[1:])
            if shards.rank == 0:
                value.copy_(whole[name])  # type: ignore[arg-type]
            dist.broadcast(value, 0)
            values[name] = value[start : start + num_primitives(params)].clone()
        rewrite(params, optimizers, values)
        # In pictures, as checkpoints have it.
        return replace(report, step=(step + 1) * shards.ranks - 1, before=before, dropped_nonfinite=dropped)


def _decide(
    policy: PruningPolicy, field: Mapping[str, Any], state: Mapping[str, Any], step: int, sums: Tensor | None
) -> tuple[Any, dict[str, Any], Tensor]:
    """What the policy makes of a whole field: outcome for all ranks, the field after it, and the rows that stayed."""
    # Surgery makes new tensors of what stays, so the field remains as it was without a copy.
    params: dict[str, Any] = {name: Parameter(value, requires_grad=False) for name, value in field.items()}
    rows = torch.arange(num_primitives(params), device=params["means"].device)
    # Surgery slices every per-primitive tensor of the state, so this one comes out as the rows that stayed.
    counted: dict[str, Any] = {**state, "rows": rows}
    try:
        report = policy.step_post_backward(
            params, {}, counted, step, contribution=None if sums is None else lambda: sums
        )
    except SundaeError as error:
        return error, params, rows
    rows = counted.pop("rows")
    changed = [name for name, value in params.items() if not torch.equal(value, field[name][rows])]
    return (report, counted, changed), params, rows
