"""The extension that prunes by a schedule, evaluates both sides of a prune, and reports it."""

from __future__ import annotations

import math

from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.errors import SundaeError
from sundae_ns.evaluation import peak_memory
from sundae_ns.pruning.decision import FieldPruner
from sundae_ns.rendering.render import contribution
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.report import write_report
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

    def before_training(self, run: TrainingRun) -> None:
        """Warn if training ends before the prune or the head."""
        if run.last_step is not None:
            _warn_if_too_short(run, self.schedule.config, run.last_step)

    def needs_all(self, run: TrainingRun) -> bool:
        """Whether a prune is due."""
        return self.schedule.due(run.state.pruning, run.state.schedule_step, run.source.total)

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
            pruner = FieldPruner(state.field, state.optimizers, [state.densification])
            report = self.schedule.after_step(pruner, state.pruning, state.schedule_step, contribute)
        except SundaeError:
            # Do not lose the warm-up to an option that can be corrected: a resumed run prunes at its first step.
            run.save()
            raise
        settled = state.schedule_step >= config.settled_at
        pruned = settled or (config.ends_growth_at is not None and state.pruning["num_prunes"] > 0)
        if pruned:
            with_head = settled and state.schedule_step >= state.head_starts_at
            notify_pruned(state.schedulers, state.step, run.source.total, last=with_head)
        if report is None:
            return
        CONSOLE.log(report.summary())
        if report.dropped_nonfinite:
            warn(f"removed {report.dropped_nonfinite} primitives that were not finite")
        after = _evaluated(run, "pruned") if evaluate else {}
        write_report(run, report, before=before, after=after)

    def finish(self, run: TrainingRun) -> None:
        """Report the peak, and warn if nothing was pruned."""
        state = run.state
        primitives, memory = state.pruning["peak"], peak_memory(state.device) / 1e6
        CONSOLE.log(f"peak: {primitives:,} primitives, {memory:,.0f} MB of {state.device.type} memory")
        run.log_scalars("Peak", {"primitives": primitives, "memory_mb": memory})
        _warn_if_too_short(run, self.schedule.config, run.state.step)


def _warn_if_too_short(run: TrainingRun, pruning: PruningConfig, last_step: int) -> None:
    """Warn if a training that ends with this step does not reach its first prune, its last prune, or its head."""
    state, target, pruned = run.state, pruning.target_primitives, run.state.pruning["num_prunes"]
    # A warm start is pruned at once.
    first = pruning.first_prune if state.offset == 0 else None
    begins, ends = ("start", "stop") if pruning.mode == "continuous" else ("prune-at", "prune-at")
    # A head whose start is not known yet is decided upon elsewhere.
    scheduled = state.head is not None and math.isfinite(state.head_starts_at)
    idle = scheduled and last_step + state.offset <= state.head_starts_at
    and_head = ", and the head stays disabled" if idle else ""
    reached = pruned and target is not None and run.source.total <= target
    if first is not None and last_step < first and not pruned:
        event, step, option, found = "first prune", first, f"pruning.{begins}", "nothing is pruned" + and_head
    elif first is not None and last_step < pruning.last_due and not reached:
        event, step, option = "last prune", pruning.last_due, f"pruning.{ends}"
        found = "more primitives are left than asked for" + and_head
    elif idle:
        # The head is enabled in the steps after that one.
        event, step, found = "head", int(state.head_starts_at) + 1 - state.offset, "it stays disabled"
        option = "head.start-at" if state.head_starts_at != pruning.settled_at else f"pruning.{ends}"
    else:
        return
    warn(
        f"training ends after {last_step + 1:,} steps, and the {event} needs more than {step:,} "
        f"({option}): {found}; train longer, or {'enable it' if option.startswith('head') else 'prune'} earlier"
    )


def _evaluated(run: TrainingRun, label: str) -> dict[str, float]:
    results = run.evaluate()
    if results:
        CONSOLE.log(f"{label}: PSNR {results['psnr']:.2f} dB, SSIM {results['ssim']:.4f} on all test views")
    return results
