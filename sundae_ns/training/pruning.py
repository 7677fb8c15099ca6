"""The extension that prunes by a schedule, evaluates both sides of a prune, and reports it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.errors import SundaeError
from sundae_ns.pruning.cutting import FieldPruner
from sundae_ns.rendering.contribution import contribution
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.report import report_peak, write_report
from sundae_ns.training.schedulers import notify_pruned
from sundae_ns.training.schedules import PruningSchedule
from sundae_ns.training.warning import warn


class ScheduledPruning(Extension):
    """Prunes when the schedule says so.

    Args:
        schedule: when, and to how many primitives.
        evaluate: whether to evaluate all test views right before and right after the one-shot prune.
    """

    name = "pruning"

    def __init__(self, schedule: PruningSchedule, *, evaluate: bool) -> None:
        self.schedule = schedule
        self.evaluate = evaluate
        self.pruner: Callable[..., FieldPruner] = FieldPruner
        """Makes the pruner of field, optimizers and running states; several ranks have their own."""

    @property
    def _searching(self) -> bool:
        """Whether a budget search prunes in place of the schedule."""
        return self.schedule.config.mode == "auto"

    def before_training(self, run: TrainingRun) -> None:
        """Warn if training ends before the prune or the head."""
        if run.last_step is not None:
            self._warn_if_too_short(run, run.last_step)

    def after_step(self, run: TrainingRun) -> None:
        """Prune if it is due, evaluate, report, and restart the learning rates.

        Raises:
            SundaeError: the field cannot be pruned. A checkpoint is saved first.
        """
        state, config = run.state, self.schedule.config
        # Growing peaks before culling.
        state.pruning["peak"] = max(state.pruning["peak"], state.densification.get("peak", 0))
        total = run.source.total
        due = self.schedule.due(state.pruning, state.schedule_step, total)
        if due:
            CONSOLE.log(f"step {state.step}: pruning {total:,} primitives, with passes over the training views")
        evaluate = due and self.evaluate and config.ends_growth_at is not None
        before = _evaluated(run, "warm-up") if evaluate else {}

        def contribute(count: int | None) -> Tensor:
            return contribution(run.source, run.training_views(), run.background, run.settings, count, console=CONSOLE)

        try:
            pruner = self.pruner(state.field, state.optimizers, [state.densification])
            report = self.schedule.after_step(pruner, state.pruning, state.schedule_step, contribute)
        except SundaeError:
            # Do not lose the warm-up to an option that can be corrected: a resumed run prunes at its first step.
            run.save()
            raise
        settled = state.schedule_step >= config.settled_at
        pruned = settled or (config.ends_growth_at is not None and state.pruning["num_prunes"] > 0)
        if pruned and not self._searching:
            with_head = settled and state.schedule_step >= state.head_starts_at
            notify_pruned(state.schedulers, state.step, run.source.total, last=with_head)
        if report is None:
            return
        # In steps of one image, as in checkpoints.
        report = replace(report, step=(report.step + 1) * run.images_per_step - 1)
        CONSOLE.log(report.summary())
        if report.dropped_nonfinite:
            warn(f"removed {report.dropped_nonfinite} primitives that were not finite")
        after = _evaluated(run, "pruned") if evaluate else {}
        write_report(run, report, before=before, after=after)

    def finish(self, run: TrainingRun) -> None:
        """Report the peak, and warn if nothing was pruned; a budget search reports by itself."""
        report_peak(run)
        if not self._searching:
            self._warn_if_too_short(run, run.state.step)

    def _warn_if_too_short(self, run: TrainingRun, last_step: int) -> None:
        """Warn if a training that ends with this step does not reach its first prune, its last prune, or its head."""
        short = _shortage(run, self.schedule.config, last_step)
        if short is None:
            return
        mend = "enable it" if short.option.startswith("head") else "prune"
        # In steps of one image, as options count.
        images = run.images_per_step
        warn(
            f"training ends after {(last_step + 1) * images:,} steps, and the {short.event} needs more than "
            f"{short.step * images:,} ({short.option}): {short.consequence}; train longer, or {mend} earlier"
        )


class _Shortage(NamedTuple):
    """Something that a training is too short for."""

    event: str
    step: int
    """Step that it needs more than."""
    option: str
    """Option that sets this step."""
    consequence: str


def _shortage(run: TrainingRun, pruning: PruningConfig, last_step: int) -> _Shortage | None:
    """What a training that ends with this step is too short for."""
    state = run.state
    warm = state.offset > 0
    first, target = pruning.first_prune, pruning.target_primitives
    begins, ends = ("start", "stop") if pruning.mode == "continuous" else ("prune-at", "prune-at")
    # A head whose start is not known yet is decided upon elsewhere.
    scheduled = state.head is not None and math.isfinite(state.head_starts_at)
    idle = scheduled and last_step + state.offset <= state.head_starts_at
    and_head = ", and the head stays disabled" if idle else ""
    # A warm start is pruned at once.
    if first is not None and not warm:
        if last_step < first and not state.pruning["num_prunes"]:
            return _Shortage("first prune", first, f"pruning.{begins}", "nothing is pruned" + and_head)
        reached = state.pruning["num_prunes"] and target is not None and run.source.total <= target
        if last_step < pruning.last_due and not reached:
            found = "more primitives are left than asked for" + and_head
            return _Shortage("last prune", pruning.last_due, f"pruning.{ends}", found)
    if not idle:
        return None
    option = "head.start-at" if state.head_starts_at != pruning.settled_at else f"pruning.{ends}"
    # The head is enabled in the steps after that one.
    return _Shortage("head", int(state.head_starts_at) + 1 - state.offset, option, "it stays disabled")


def _evaluated(run: TrainingRun, label: str) -> dict[str, float]:
    results = run.evaluate()
    if results:
        CONSOLE.log(f"{label}: PSNR {results['psnr']:.2f} dB, SSIM {results['ssim']:.4f} on all test views")
    return results
