"""Pruning schedules: when a field is pruned, and to how many primitives.

A schedule decides, a :class:`sundae_ns.pruning.cutting.FieldPruner` prunes. The running state is a dict of integers,
which checkpoints carry: a resumed run neither prunes twice nor forgets its peak.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from sundae_ns.evaluation.timing import now
from sundae_ns.pruning import PruneRule, kept_count
from sundae_ns.pruning.cutting import FieldPruner
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.report import PruneReport

NEVER = -1
"""Value of ``state["pruned_at"]`` before the first prune."""
LEAST_OPACITY = 0.005
"""Lowest opacity of primitives that share the appearance of one; 3DGS-MCMC counts lower ones as dead."""

Contribute = Callable[[int | None], Tensor]
"""Renders the training views and returns the contribution of the pruner's primitives ``[N]``; the argument is ``count``
of :func:`sundae_ns.rendering.contribution`."""


@dataclass(frozen=True)
class PruningSchedule:
    """Never prunes, and records the peak. Subclasses say when a prune is due, and how many it keeps."""

    config: PruningConfig
    """Options; not changed."""

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Whether a field of ``n`` primitives is to be pruned after this step."""
        return False

    def target(self, n: int) -> int:
        """Number of primitives that a prune keeps of ``n`` finite ones. The one place that decides this number."""
        return n

    def rule_at(self, step: int) -> PruneRule:
        """Rule of the prune at a step."""
        return self.config

    def lacking(self, step: int, n: int) -> int:
        """Number of primitives to add to ``n`` after this step."""
        return 0

    def initialize_state(self) -> dict[str, Any]:
        """Running state: step of the last prune (-1 for none), number of prunes, peak number of primitives."""
        return {"pruned_at": NEVER, "num_prunes": 0, "peak": 0}

    def after_step(
        self, pruner: FieldPruner, state: MutableMapping[str, Any], step: int, contribute: Contribute | None = None
    ) -> PruneReport | None:
        """Prune if it is due, and add primitives if they are lacking. Call it after optimizers and densification.

        Args:
            pruner: of the field.
            state: from :meth:`initialize_state`, or from a checkpoint.
            step: training step that has just ended.
            contribute: called only if the rule needs it, after primitives that are not finite have been removed.

        Returns:
            A report, or None if no prune was due.

        Raises:
            ConfigError: the rule needs a contribution and there is none.
            DataError: the field cannot be pruned, see :func:`sundae_ns.pruning.decide`.
        """
        state["peak"] = max(state["peak"], pruner.total)
        report = None
        if self.due(state, step, pruner.total):
            report = prune_to(self.target, self.rule_at(step), pruner, state, step, contribute)
        lacking = self.lacking(step, pruner.total)
        if lacking > 0:
            pruner.add(lacking, LEAST_OPACITY)
            state["peak"] = max(state["peak"], pruner.total)
        return report


class OneShotPruning(PruningSchedule):
    """Training, one prune that keeps ``keep_ratio``, then fine-tuning: the paper's main strategy."""

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """After ``prune_at``, or at once if training was resumed from a later step without a prune."""
        return state["pruned_at"] == NEVER and step >= self.config.prune_at

    def target(self, n: int) -> int:
        """``round(keep_ratio * n)``, at least 1."""
        return kept_count(self.config.keep_ratio, n)


class ContinuousPruning(PruningSchedule):
    """Periodic pruning during densification, for a lower peak of memory.

    The paper's alternative (section "Continuous Pruning as a Strategy"): each prune keeps ``keep_ratio``, so that the
    final number is only roughly known. With ``target_primitives`` each prune goes down to exactly that number; the last
    one comes after densification, so this is the final number. ``max_primitives`` is a cap on every prune, and on every
    step in between through :class:`sundae_ns.training.densification.CappedStrategy`.
    """

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """At ``start`` and every ``every`` steps until ``stop``; with a target only if there are more primitives.

        From ``stop`` on at every step with more primitives than the target or, without a target, the cap.
        """
        config, target = self.config, self.config.target_primitives
        scheduled = config.start <= step <= config.stop and (step - config.start) % config.every == 0
        most = config.max_primitives if target is None else target
        above = most is not None and n > most
        by_share = scheduled and target is None
        by_count = above and (scheduled or step >= config.stop)
        return (by_share or by_count) and step > state["pruned_at"]

    def target(self, n: int) -> int:
        """``target_primitives``, or the keep ratio's share under the cap."""
        config = self.config
        if config.target_primitives is not None:
            return min(config.target_primitives, n)
        count = kept_count(config.keep_ratio, n)
        return count if config.max_primitives is None else min(count, config.max_primitives)

    def rule_at(self, step: int) -> PruneRule:
        """The rule with a new draw at each prune, and the same one after a resume."""
        return replace(self.config, seed=self.config.seed + step)

    def lacking(self, step: int, n: int) -> int:
        """Those below ``target_primitives`` once densification has ended."""
        return (self.config.target_primitives or 0) - n if step >= self.config.stop else 0


def make_schedule(config: PruningConfig) -> PruningSchedule:
    """Schedule of the configured mode.

    Raises:
        ConfigError: an option cannot work.
    """
    config.validate()
    # In auto mode the budget search prunes; the schedule only records the peak.
    schedules = {"one-shot": OneShotPruning, "continuous": ContinuousPruning}
    return schedules.get(config.mode, PruningSchedule)(config)


def prune_to(
    target: Callable[[int], int],
    rule: PruneRule,
    pruner: FieldPruner,
    state: MutableMapping[str, Any],
    step: int,
    contribute: Contribute | None,
) -> PruneReport:
    """Prune a field in training now: drop what is not finite, decide the count, render, cut, and record the step.

    Args:
        target: maps the number of finite primitives to the number to keep.
        rule: which primitives stay.
        pruner, state, step, contribute: see :meth:`PruningSchedule.after_step`, also for errors.
    """
    device = pruner.params["means"].device
    before, started = pruner.total, now(device)
    dropped = pruner.drop_nonfinite()
    count, weights = target(pruner.total), None
    if contribute is not None and rule.uses_contribution and count < pruner.total:
        weights = contribute(count if rule.uses_detail else None)
    decision = pruner.cut(rule, count, weights)
    state.update(pruned_at=step, num_prunes=state["num_prunes"] + 1)
    return PruneReport(
        step=step,
        before=before,
        after=decision.kept,
        dropped_nonfinite=dropped,
        peak=state["peak"],
        seconds=now(device) - started,
        tau=decision.tau,
        sigma=decision.sigma,
        isolated=decision.isolated,
    )
