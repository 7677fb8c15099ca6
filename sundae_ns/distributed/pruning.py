"""One prune for all ranks: rank 0 gathers the field and decides, every rank keeps its part."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from sundae_ns.distributed.shards import Shards
from sundae_ns.errors import SundaeError
from sundae_ns.gaussians.field import Field, as_field
from sundae_ns.gaussians.mending import mend
from sundae_ns.gaussians.parameters import num_primitives
from sundae_ns.gaussians.surgery import rewrite
from sundae_ns.pruning import Decision, PruneRule, decide
from sundae_ns.pruning.cutting import FieldPruner
from sundae_ns.pruning.decision import diverged


@dataclass(eq=False)
class RankPruner(FieldPruner):
    """Prunes the shards of one field as one process prunes the whole; its verbs are collective."""

    shards: Shards = field(kw_only=True)

    @property
    def total(self) -> int:
        """Number of primitives of all ranks."""
        return self.shards.total

    def drop_nonfinite(self) -> int:
        """As :meth:`FieldPruner.drop_nonfinite`, for the primitives of all ranks. Collective.

        Raises:
            DataError: no primitive is finite.
        """
        mended, before = mend(self.params), self.total
        dropped = before - self._over_all(mended.field.num_primitives)
        if dropped == before:
            raise diverged(before)
        if mended.clamped:
            # Before primitives move between ranks.
            whole = {name: value.detach().clone() for name, value in self.params.items()}
            for name, value in mended.field.items():
                whole[name][mended.mask] = value
            rewrite(self.params, self.optimizers, whole)
        if dropped:
            self._keep(mended.mask)
        return dropped

    def _keep(self, mask: Tensor) -> None:
        self.shards.level(self.params, self.optimizers, self.states, mask)

    def _over_all(self, number: int) -> int:
        return sum(found for (found,) in self.shards.numbers(number))

    @torch.no_grad()
    def cut(self, rule: PruneRule, count: int, contribution: Tensor | None = None) -> Decision:
        """Decide on rank 0, remove and merge on all. Collective; an error of rank 0 is raised on every rank.

        Args:
            contribution: of this rank's primitives ``[N_r]``, on all ranks or on none.
        """
        shards = self.shards
        for held in self.params.values():
            held.grad = None  # surgery drops it too, but only after the whole field has been gathered
        weights = None if contribution is None else shards.gather(contribution)
        whole: dict[str, Any] = {name: shards.gather(value) for name, value in self.params.items()}
        mask, values = torch.empty(shards.total, dtype=torch.bool, device=shards.device), {}
        outcome: Any = None
        if shards.rank == 0:
            try:
                decision = decide(Field(whole, as_field(self.params).encoding), rule, count, weights)
                mask, values = decision.mask, dict(decision.values or {})
                outcome = replace(decision, mask=torch.empty(0), values=None), list(values)
            except SundaeError as error:
                outcome = error
        outcome = shards.announce(outcome)
        if isinstance(outcome, SundaeError):
            raise outcome
        figures, names = outcome

        dist.broadcast(mask, 0)
        self._keep(mask[self._rows()])
        rows = self._rows()
        for name in names:
            own = self.params[name]
            value = values[name].to(own) if name in values else own.new_empty(shards.total, *own.shape[1:])
            dist.broadcast(value, 0)
            values[name] = value[rows].clone()
        rewrite(self.params, self.optimizers, values)
        return replace(figures, mask=mask)

    def _rows(self) -> slice:
        """This rank's rows of the whole field."""
        start = sum(self.shards.counts[: self.shards.rank])
        return slice(start, start + num_primitives(self.params))
