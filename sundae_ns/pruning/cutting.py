"""Pruning of a field in training: parameters, optimizers and running states together."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from sundae_ns.gaussians.mending import mend
from sundae_ns.gaussians.parameters import num_primitives
from sundae_ns.gaussians.relocation import grow
from sundae_ns.gaussians.surgery import keep, per_primitive, rewrite
from sundae_ns.pruning.decision import Decision, decide, diverged
from sundae_ns.pruning.rule import PruneRule


@dataclass(eq=False)
class FieldPruner:
    """Prunes a field in place."""

    params: MutableMapping[str, Parameter]
    """The field, name to parameter ``[N, ...]``; its parameters are replaced."""
    optimizers: Mapping[str, Optimizer]
    """By parameter name, one parameter each; others are left alone."""
    states: Sequence[MutableMapping[str, Any]] = ()
    """Running states on the same primitives; their tensors of N rows are sliced along."""

    @property
    def total(self) -> int:
        """Number of primitives of the whole field."""
        return num_primitives(self.params)

    def drop_nonfinite(self) -> int:
        """Remove the primitives with a NaN, or an infinite parameter without a meaning; clamp the others (``mend``).

        Call it before the contribution, which renders the field: one NaN spreads over the image.

        Returns:
            Number of removed primitives.

        Raises:
            DataError: no primitive is finite; the field is unchanged.
        """
        mended = mend(self.params)
        if not mended.field.num_primitives:
            raise diverged(mended.dropped)
        if mended.dropped:
            self._keep(mended.mask)
        if mended.clamped:
            rewrite(self.params, self.optimizers, mended.field)
        return mended.dropped

    def drop(self, mask: Tensor, *, at_most: float) -> int:
        """Remove the primitives under a mask, unless they are too many.

        Args:
            mask: bool ``[N]``.
            at_most: largest share of the whole field that is removed, below 1.

        Returns:
            Number of removed primitives.
        """
        count = int(mask.sum())
        if not 0 < count <= at_most * self.total:
            return 0
        self._keep(~mask)
        return count

    def _keep(self, mask: Tensor) -> None:
        """Keep the primitives of this process under a mask ``[N]``."""
        keep(self.params, self.optimizers, self.states, mask)

    @torch.no_grad()
    def cut(self, rule: PruneRule, count: int, contribution: Tensor | None = None) -> Decision:
        """Decide, remove and merge; see :func:`sundae_ns.pruning.decide` for arguments and errors.

        Args:
            contribution: of the primitives ``[N]``.
        """
        decision = decide(self.params, rule, count, contribution)
        self._keep(decision.mask)
        if decision.values is not None:
            rewrite(self.params, self.optimizers, decision.values)
        return decision

    def add(self, count: int, least_opacity: float) -> None:
        """Add ``count`` primitives on top of others, which share their opacity, so that no image changes.

        Per-primitive statistics are dropped: call it once densification has ended.
        """
        n = num_primitives(self.params)
        grow(self.params, self.optimizers, count, least_opacity)
        for state in self.states:
            state.update(dict.fromkeys(name for name, value in state.items() if per_primitive(value, n)))
