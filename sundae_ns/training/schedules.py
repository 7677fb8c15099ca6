"""Pruning schedules: when a field is pruned, and to how many primitives.

A schedule decides, a :class:`sundae_ns.pruning.decision.FieldPruner` prunes. The running state is a dict of integers,
which checkpoints carry: a resumed run neither prunes twice nor forgets its peak.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from sundae_ns.evaluation.timing import now
from sundae_ns.pruning import PruneRule, kept_count
from sundae_ns.pruning.decision import FieldPruner
from sundae_ns.training.pruning_config import USUAL_SHARE, PruningConfig
from sundae_ns.training.report import PruneReport

NEVER = -1
"""Value of ``state["pruned_at"]`` before the first prune."""
COUNT = "count"
"""Key of the running state with the number that trials have chosen; 0 for the usual share."""
LEAST_OPACITY = 0.005
"""Lowest opacity of primitives that share the appearance of one; 3DGS-MCMC counts lower ones as dead."""

Contribute = Callable[[int | None], Tensor]
"""Renders the training views and returns the contribution of the pruner's primitives ``[N]``; the argument is ``count``
of :func:`sundae_ns.rendering.contribution`."""


@dataclass(frozen=True)
class PruningSchedule:
    """The schedule of a pruning mode.

    ``one-shot`` is the paper's main strategy: training, one prune that keeps ``keep_ratio`` or, once trials have chosen
    it, their number, then fine-tuning.
    ``continuous`` is the paper's alternative: periodic pruning during densification, for a lower peak of memory. Each
    prune keeps ``keep_ratio``, so the final number is only roughly known; with ``target_primitives`` it is exact,
    because the last prune comes after densification. ``max_primitives`` caps every prune, and every step in between
    through :class:`sundae_ns.training.densification.CappedStrategy`. ``off`` only
    records the peak.
    """

    config: PruningConfig
    """Valid options; not changed."""

    def due(self, state: Mapping[str, Any], step: int, n: int) -> bool:
        """Whether a field of ``n`` primitives is to be pruned after this step.

        One-shot: after ``prune_at``, or at once if training was resumed from a later step without a prune. Continuous:
        at ``start`` and every ``every`` steps until ``stop``; with a target only if there are more primitives. From
        ``stop`` on at every step with more primitives than the target or, without a target, the cap.
        """
        config = self.config
        if config.mode == "one-shot":
            decided = not config.decides or COUNT in state
            return decided and state["pruned_at"] == NEVER and step >= config.prune_at
        if config.mode != "continuous":
            return False
        target = config.target_primitives
        scheduled = config.start <= step <= config.stop and (step - config.start) % config.every == 0
        most = config.max_primitives if target is None else target
        by_count = most is not None and n > most and (scheduled or step >= config.stop)
        return ((scheduled and target is None) or by_count) and step > state["pruned_at"]

    def target(self, n: int, state: Mapping[str, Any]) -> int:
        """Number of primitives that a prune keeps of ``n`` finite ones. The one place that decides this number.

        ``target_primitives``, the number that trials have chosen, or ``round(keep_ratio * n)``, at least 1, under the
        cap.
        """
        config = self.config
        if config.target_primitives is not None:
            return min(config.target_primitives, n)
        chosen = state.get(COUNT, 0) if config.decides else 0
        share = USUAL_SHARE if config.keep_ratio is None else config.keep_ratio
        count = min(chosen, n) if chosen else kept_count(share, n)
        return count if config.max_primitives is None else min(count, config.max_primitives)

    def initialize_state(self) -> dict[str, Any]:
        """Running state: step of the last prune (-1 for none), number of prunes, peak number of primitives."""
        return {"pruned_at": NEVER, "num_prunes": 0, "peak": 0}

    def after_step(
        self, pruner: FieldPruner, state: MutableMapping[str, Any], step: int, contribute: Contribute | None = None
    ) -> PruneReport | None:
        """Prune if it is due; add the primitives that lack to the target. Call it after optimizers and densification.

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
        config, report = self.config, None
        state["peak"] = max(state["peak"], pruner.total)
        if self.due(state, step, pruner.total):
            # Continuous pruning draws anew each time, and the same after a resume.
            rule = replace(config, seed=config.seed + step) if config.mode == "continuous" else config
            report = prune_to(lambda n: self.target(n, state), rule, pruner, state, step, contribute)
        lacking = (config.target_primitives or 0) - pruner.total
        if config.mode == "continuous" and step >= config.stop and lacking > 0:
            pruner.add(lacking, LEAST_OPACITY)
            state["peak"] = max(state["peak"], pruner.total)
        return report


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
