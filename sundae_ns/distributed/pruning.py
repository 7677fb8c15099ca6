"""One prune for all ranks: rank 0 gathers the field and decides, every rank keeps its part."""

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
from sundae_ns.gaussians.field import Encoding, Field, as_field
from sundae_ns.gaussians.parameters import finite_mask, num_primitives
from sundae_ns.gaussians.surgery import rewrite
from sundae_ns.pruning.scores import Contribution
from sundae_ns.training.report import PruneReport
from sundae_ns.training.schedules import PruningSchedule


@dataclass(frozen=True)
class GlobalPruning(PruningSchedule):
    """A pruning schedule over the shards of one field."""

    schedule: PruningSchedule
    shards: Shards

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Whether a field of ``n`` primitives is pruned after this step."""
        return self.schedule.due(state, step, n)

    def target(self, n: int) -> int:
        """Number of primitives that a prune keeps of ``n``."""
        return self.schedule.target(n)

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
        """Prune if it is due; see :class:`sundae_ns.training.schedules.PruningSchedule`. Collective."""
        shards, before = self.shards, self.shards.total
        state["peak"] = max(state["peak"], before)
        if not self.schedule.due(state, step, before):
            return None
        for held in params.values():
            held.grad = None  # surgery drops it too, but only after the whole field has been gathered
        states = [] if strategy_state is None else [strategy_state]
        finite = finite_mask(params)
        dropped = before - sum(count for (count,) in shards.numbers(int(finite.sum())))
        if dropped == before:
            raise DataError(
                f"none of {before} primitives is finite: the training has diverged, resume from an earlier checkpoint"
            )
        if dropped:
            shards.level(params, optimizers, states, finite)
        needed = contribution is not None and self.config.uses_contribution and self.config.keep_ratio < 1
        sums = shards.gather(contribution()) if contribution is not None and needed else None
        whole: Mapping[str, Any] = {name: shards.gather(value) for name, value in params.items()}

        outcome: Any = None
        rows = torch.empty(0, dtype=torch.bool, device=shards.device)
        if shards.rank == 0:
            outcome, whole, rows = _decide(self.schedule, whole, state, step, sums, as_field(params).encoding)
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
        # In steps of one image, as in checkpoints.
        return replace(report, step=(step + 1) * shards.ranks - 1, before=before, dropped_nonfinite=dropped)


def _decide(
    schedule: PruningSchedule,
    gathered: Mapping[str, Any],
    state: Mapping[str, Any],
    step: int,
    sums: Tensor | None,
    encoding: Encoding,
) -> tuple[Any, Mapping[str, Any], Tensor]:
    """Prune the gathered field: outcome for all ranks, the field afterwards, and the rows that are kept."""
    # Surgery makes new tensors, so the gathered ones stay without a copy.
    params = Field({name: Parameter(value, requires_grad=False) for name, value in gathered.items()}, encoding)
    rows = torch.arange(num_primitives(params), device=params["means"].device)
    # Surgery slices every per-primitive tensor of the state, so this one becomes the rows that are kept.
    counted: dict[str, Any] = {**state, "rows": rows}
    try:
        report = schedule.step_post_backward(
            params, {}, counted, step, contribution=None if sums is None else lambda: sums
        )
    except SundaeError as error:
        return error, params, rows
    rows = counted.pop("rows")
    changed = [name for name, value in params.items() if not torch.equal(value, gathered[name][rows])]
    return (report, counted, changed), params, rows
