"""The extension that carries out a budget search on the field in training."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.compensation import HeadConfig
from sundae_ns.errors import ConfigError, DataError, SundaeError
from sundae_ns.gaussians import from_points
from sundae_ns.storage import accounting, megabytes, stored_bytes
from sundae_ns.training.budget import heads
from sundae_ns.training.budget.search import NO_IMAGE, SearchProgress
from sundae_ns.training.budget.searched_field import SearchedField
from sundae_ns.training.densification import Densification
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.report import PruneReport, write_record, write_report
from sundae_ns.training.trials.engine import TrialEngine
from sundae_ns.training.warning import warn

MAX_REJECTED = 5
"""Cuts that may be rejected, before and after the head is enabled."""
TRIAL_EVALUATIONS = 3
"""Length of the training at one SH degree, in evaluations."""
FLAT_SHARE = 0.25
"""Share of the tolerated drop that view-independent colours may cost when they are introduced."""


class BudgetSearch(Extension):
    """The search of one run: its state, and the fields that it may return to.

    Args:
        config: options of pruning, mode auto.
        head: configuration of the largest head that may be enabled.
        densification: its running state starts anew when the search begins.
        state: the field; its head stays disabled until the search enables it.
    """

    name = "budget"

    def __init__(
        self, config: PruningConfig, head: HeadConfig, densification: Densification, state: FieldState
    ) -> None:
        self.config = config
        self.search = SearchProgress()
        self._largest = None if head.mode == "off" else head
        self._densification = densification
        self._engine = TrialEngine()
        self._engine.enable_head(state, False)
        self._flat: Tensor | None = None
        """Primitives with view-independent colours, bool ``[N]``; None before the search has ended."""

    def searched(self, run: TrainingRun) -> SearchedField:
        """The field of a run under this search."""
        return SearchedField(run, self.config, self.search, self._engine, self._largest)

    def state_dict(self) -> dict[str, Any]:
        """Numbers of the search and, while it goes on, copies of the fields that it may return to."""
        return {"numbers": asdict(self.search), "engine": self._engine.state_dict(), "flat": self._flat}

    def prepare_loading(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Give field and head the shapes of a checkpoint.

        Raises:
            CheckpointError: the checkpoint carries no search, or a damaged one.
        """
        heads.reshape(state, SearchProgress.from_state(saved.get("numbers")), self._largest)

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`.

        Raises:
            CheckpointError: the checkpoint carries no search, or a damaged one.
        """
        search, engine = SearchProgress.from_state(saved.get("numbers")), TrialEngine()
        needed = {"accepted": search.trying, "fallback": search.phase in ("degrees", "head")}
        engine.load_state_dict(state, saved.get("engine", {}))
        engine.require(*(name for name, due in needed.items() if due), trial=False)
        self.search, self._engine, self._flat = search, engine, saved.get("flat")
        engine.enable_head(state, search.head)

    def before_training(self, run: TrainingRun) -> None:
        """Check that views are held out, and that the budget suffices for one primitive.

        Raises:
            ConfigError: no training view is held out, or the budget is too small.
        """
        # With its own generator, because the random state of a checkpoint has been restored by now.
        origin, generator = torch.zeros(1, 3), torch.Generator()
        least = stored_bytes(from_points(origin, origin, sh_degree=0, num_features=0, generator=generator), None)
        if self.config.max_bytes is not None and self.config.max_bytes < least:
            raise ConfigError(
                f"pruning.max-bytes is {self.config.max_bytes:,}, and one primitive takes {least}; give more"
            )
        if not run.num_heldout:
            raise ConfigError(
                "pruning.mode auto judges by held-out training views, and there are none: give "
                "--pipeline.datamanager.holdout-every 8, or less for fewer training views"
            )

    def after_step(self, run: TrainingRun) -> None:
        """Evaluate or cut if it is due.

        Raises:
            DataError: the budget is too small for one primitive, or the field cannot be scored. A checkpoint is saved.
        """
        searched = self.searched(run)
        if self._flat is not None:
            rest = searched.field["features_rest"]
            self._flat = self._flat.to(rest.device)
            rest.data.mul_(~self._flat[:, None, None])
        started = time.perf_counter()
        try:
            if not self._act(searched):
                return
        except SundaeError:
            # Do not lose the warm-up to an option that can be corrected.
            run.save()
            raise
        self.search.seconds += time.perf_counter() - started
        self._write(searched)

    def _act(self, searched: SearchedField) -> bool:
        """Begin, end a trial, or evaluate if it is due; returns whether anything was due."""
        phase = self.search.phase
        if phase == "before" and searched.state.schedule_step >= self.config.prune_at:
            self._begin(searched)
        elif phase == "degrees" and (self._trained(searched) or self._time_is_up(searched)):
            self._end_trial(searched)
        elif phase in ("field", "head") and self._evaluation_is_due(searched):
            self._evaluate(searched)
        else:
            return False
        return True

    def finish(self, run: TrainingRun) -> None:
        """Evaluate the final field against the target, and log whether it was reached."""
        config, search = self.config, self.search
        if search.phase == "before":
            warn("training ended before the budget search began (pruning.prune-at)")
            return
        searched, state = self.searched(run), run.state
        end = searched.evaluation(searched.measure(), "final", "reached")
        drop, count = search.reference - end.psnr, searched.count
        option, limit = budget_of(config)
        cost = {"max_psnr_drop": drop, "max_bytes": end.bytes, "max_primitives": count}[option]
        end.verdict = "reached" if cost <= limit else "missed"
        search.curve = [old for old in search.curve if old.phase != "final"] + [end]
        unfinished = ""
        if search.phase != "done":
            # After a warm start, steps of the schedule run ahead of training steps.
            last = max(config.stop, state.schedule_step + config.search_every) - state.schedule_step + state.step
            unfinished = f" The search had not ended: train on to step {last}."
        CONSOLE.log(
            f"budget {option} {limit:,}: {end.verdict}. {count:,} of {search.before:,} primitives, "
            f"{megabytes(end.bytes)}, SH degree {searched.field.sh_degree}, "
            f"{'with' if search.head else 'no'} head, {drop:+.3f} dB lost on {search.views} held-out views.{unfinished}"
        )
        self._write(searched)

    def _begin(self, searched: SearchedField) -> None:
        search, state = self.search, searched.state
        searched.drop_nonfinite()
        # Densification has ended, and its statistics would not match a field that is restored with more primitives.
        self._densification.initialize(state)
        search.began, search.before, search.views = state.schedule_step, searched.count, searched.run.num_heldout
        search.reference = searched.measure()
        if search.reference == NO_IMAGE:
            raise DataError(
                "the warm-up field renders images that are not finite: the training has diverged, resume from an "
                "earlier checkpoint"
            )
        search.target = search.reference - self.config.tolerated_drop
        CONSOLE.log(
            f"step {state.step}: warm-up field of {searched.count:,} primitives, PSNR {search.reference:.3f} dB on "
            f"{search.views} held-out training views"
        )
        searched.restart_rates(head=False)
        search.degree = searched.field.sh_degree
        if search.degree > 0 and not self._time_is_up(searched):
            search.phase, search.cut_at = "degrees", state.schedule_step
            searched.keep("fallback")
        else:
            self._after_degrees(searched)

    def _trained(self, searched: SearchedField) -> bool:
        """Whether the trial of an SH degree has its full length."""
        return searched.state.schedule_step - self.search.cut_at >= TRIAL_EVALUATIONS * self.config.search_every

    def _end_trial(self, searched: SearchedField) -> None:
        """Measure the trial of an SH degree; start the next one from the warm-up field, or choose a degree."""
        search, tolerated, step = self.search, self.config.tolerated_drop, searched.state.schedule_step
        if self._trained(searched):
            value = search.degrees[str(search.degree)] = searched.measure_finite()
            top = max(int(name) for name in search.degrees)
            if search.degree == search.lowest_degree(top, tolerated):
                if value > NO_IMAGE:
                    searched.keep("accepted")
                else:
                    self._engine.kept["accepted"] = self._engine.kept["fallback"]
            degree = search.next_degree(top, tolerated)
            if len(search.degrees) > 1 or value == NO_IMAGE:  # this trial, or the one that it has replaced
                search.steps_lost += step - search.cut_at
            if degree is not None:
                searched.go_back("fallback")
                if degree < search.degree:
                    searched.lower_degree(degree)
                search.cut_at = step
                return
            if search.degree != search.lowest_degree(top, tolerated) or value == NO_IMAGE:
                searched.go_back("accepted")
        elif search.degrees:  # the run ends during the trial; the warm-up's own degree needs no proof
            search.steps_lost += step - search.cut_at
            searched.go_back("accepted")
        del self._engine.kept["fallback"]
        if search.degrees:
            levels = ", ".join(f"{name}: {value:.3f}" for name, value in search.degrees.items())
            CONSOLE.log(f"SH degree {search.degree} (PSNR by degree after the same training: {levels} dB)")
        self._after_degrees(searched)

    def _after_degrees(self, searched: SearchedField) -> None:
        if budget_of(self.config)[0] != "max_psnr_drop":
            self._fit(searched)
            self._done(searched)
            return
        self.search.begin("field", searched.count)
        value, (_, _, over) = searched.measure(), self._clock(searched)
        if over:
            self._end_phase(searched, value)
        else:
            self._cut_or_wait(searched, value)

    def _time_is_up(self, searched: SearchedField) -> bool:
        """Whether the search must end at this step. A run that ends before ``stop`` may be trained on."""
        return searched.state.schedule_step >= self.config.stop and searched.steps_left == 0

    def _clock(self, searched: SearchedField) -> tuple[bool, int, bool]:
        """Whether a head may follow this phase, steps in which a cut must recover, whether another is too late."""
        search, step = self.search, searched.state.schedule_step
        if search.phase != "field" or searched.head_for(searched.count) is None:
            return False, searched.steps_left, self._is_over(searched, self.config.stop, searched.steps_left)
        deadline = (search.began + self.config.stop) // 2  # half of the time belongs to the head
        return True, deadline - step, self._is_over(searched, deadline, deadline - step)

    def _is_over(self, searched: SearchedField, deadline: int, left: int) -> bool:
        """Whether too few steps are left to judge another cut."""
        return searched.state.schedule_step >= deadline or left < self.config.patience * self.config.search_every

    def _evaluation_is_due(self, searched: SearchedField) -> bool:
        regular = (searched.state.schedule_step - self.search.began) % self.config.search_every == 0
        return regular or (self.search.trying and self._time_is_up(searched))

    def _evaluate(self, searched: SearchedField) -> None:
        search, config, state = self.search, self.config, searched.state
        head_to_come, left, over = self._clock(searched)
        value = searched.measure() if search.trying else searched.measure_finite()
        verdict = search.judge(value, state.schedule_step, left, config.patience)
        point = searched.evaluation(value, search.phase, verdict)
        search.curve.append(point)
        CONSOLE.log(
            f"step {state.step}: {point.primitives:,} primitives, {value - search.target:+.3f} dB to the target, "
            f"{point.since_cut} steps after the cut: {verdict}"
        )
        searched.run.log_scalars(
            "Budget", {"primitives": point.primitives, "psnr": value, "to_target": value - search.target}
        )
        if verdict == "waiting":
            return
        if verdict == "rejected":
            searched.go_back("accepted")
            value = search.before_cut
        # Do not wait for a head that does not help, or for a field while a head is to come.
        tired = {"field": 1 if head_to_come else math.inf, "head": math.inf if search.cuts else 3}[search.phase]
        lost = search.head and value == NO_IMAGE  # training cannot repair its weights
        if over or lost or search.looks >= tired * config.patience or search.rejected >= MAX_REJECTED:
            self._end_phase(searched, value)
        else:
            self._cut_or_wait(searched, value)

    def _cut_or_wait(self, searched: SearchedField, value: float) -> None:
        """Cut as deep as the margin allows, or not at all."""
        config, search = self.config, self.search
        count = search.next_count(value, config.num_neighbors + 1 if config.uses_graph else 1, config.patience)
        if count is None or searched.steps_left < config.search_every:  # no evaluation would judge it
            return
        searched.keep("accepted")
        searched.cut_to(count)
        search.cut(value, count, searched.state.schedule_step)

    def _end_phase(self, searched: SearchedField, value: float) -> None:
        search, step, head = self.search, searched.state.schedule_step, searched.head_for(searched.count)
        too_late = self._is_over(searched, self.config.stop, searched.steps_left)
        if search.phase == "field" and head is not None and not too_late:
            searched.keep("fallback")
            search.begin("head", search.accepted)
            search.head_at, search.lost_at_join = step, search.steps_lost
            searched.enable_head(head)
            return
        if search.phase == "head":
            without = len(self._engine.kept["fallback"]["field"]["means"]["value"]) * searched.row
            if value == NO_IMAGE or searched.stored >= without:
                search.steps_lost = search.lost_at_join + step - search.head_at
                search.head = False
                self._engine.enable_head(searched.state, False)
                searched.go_back("fallback")
        if not search.head:
            searched.remove_head()
        self._done(searched)

    def _fit(self, searched: SearchedField) -> None:
        """Cut to the number of primitives that a budget of bytes or primitives allows."""
        config, search = self.config, self.search
        row, count = searched.row, min(config.max_primitives or searched.count, searched.count)
        if config.max_bytes is not None:
            count = min(config.max_bytes // row, searched.count)
            if count == 0:
                raise DataError(
                    f"pruning.max-bytes is {config.max_bytes:,}, and one primitive takes {row:,}; give more"
                )
        head = searched.head_for(count)
        if head is None:
            searched.remove_head()
        else:
            searched.enable_head(head)
        if config.max_bytes is not None:
            count = accounting.rows_within(searched.field, config.max_bytes, lambda rows: stored_bytes(rows, head))
        if count < searched.count:
            searched.cut_to(count)
            search.cut_at = searched.state.schedule_step
        search.accepted = searched.count
        search.curve.append(searched.evaluation(searched.measure(), "field", "cut"))

    def _done(self, searched: SearchedField) -> None:
        search, state = self.search, searched.state
        search.phase = "done"
        self._engine.kept = {}
        value = searched.measure() if searched.field.sh_degree > 0 else NO_IMAGE
        if value > NO_IMAGE:
            least = value - FLAT_SHARE * self.config.tolerated_drop
            if searched.steps_left == 0:  # no training follows that could recover it
                least = max(least, min(value, search.target))
            self._flat = searched.flatten(least)
            search.zeroed = int(self._flat.sum())
            CONSOLE.log(f"{search.zeroed:,} of {searched.count:,} primitives get view-independent colours")
        report = PruneReport(
            step=state.schedule_step,
            before=search.before,
            after=searched.count,
            dropped_nonfinite=search.dropped_nonfinite,
            peak=state.pruning["peak"],
            seconds=search.seconds,
        )
        CONSOLE.log(report.summary())
        write_report(searched.run, report, before={}, after={})

    def _write(self, searched: SearchedField) -> None:
        """Write curve, choice and cost of the search to ``budget.json``.

        Raises:
            StorageError: no space or no right to write.
        """
        run, search = searched.run, self.search
        if run.last_step is None:
            return
        (option, limit), share = budget_of(self.config), search.steps_lost / (run.last_step + 1)
        cost = {"steps_lost": search.steps_lost, "share_of_steps": share, "seconds": search.seconds}
        record = {"budget": {option: limit}, **asdict(search), "primitives": searched.count, "cost": cost}
        write_record(run, "budget.json", record)


def budget_of(config: PruningConfig) -> tuple[str, float]:
    """Name and value of the option that sets the budget."""
    for name in ("max_bytes", "max_primitives"):
        value = getattr(config, name)
        if value is not None:
            return name, value
    return "max_psnr_drop", config.tolerated_drop
