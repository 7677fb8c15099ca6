"""What a search decides, done to the field of a run, step by step; the order of things is told in the package's own words."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.datamanager import SundaeDatamanager
from sundae_ns.errors import CheckpointError, ConfigError, DataError
from sundae_ns.gaussians import from_points
from sundae_ns.gaussians.snapshot import Snapshot
from sundae_ns.pruning import PruningConfig
from sundae_ns.storage import accounting, megabytes
from sundae_ns.training.after_step import record, refresh
from sundae_ns.training.budget import heads, sizes
from sundae_ns.training.budget.checkpoints import search_of, shapes
from sundae_ns.training.budget.harmonics import flatten, leave_bands
from sundae_ns.training.budget.record import point_of, wanted, write
from sundae_ns.training.budget.run import Run
from sundae_ns.training.budget.search import NO_PICTURE, Point, Search
from sundae_ns.training.report import PruneReport

if TYPE_CHECKING:
    from sundae_ns.model import SundaeModel

MAX_REJECTED = 5
"""Cuts that may be taken back, before and after the head has joined."""
TRIAL_LOOKS = 3
"""Length, in looks, of the training that is compared with other bands."""
FLAT_SHARE = 0.25
"""Share of the tolerated drop that flat colours may cost, right when bands go."""


class _Clock(NamedTuple):
    """What time there is in a phase."""

    head_to_come: bool
    """Whether a head may join after it."""
    left: int
    """Steps of training that a cut has to recover in."""
    over: bool
    """Whether it is too late for another cut."""


class Budget:
    """The search of one run: its state, and the fields that it may go back to.

    Args:
        config: options of pruning, mode auto.
        head: configuration of the head that may take part.
    """

    def __init__(self, config: PruningConfig, head: HeadConfig) -> None:
        self.config = config
        self._largest = None if head.mode == "off" else head
        self.search = Search()
        self._accepted: dict[str, Snapshot] | None = None
        self._fallback: dict[str, Snapshot] | None = None
        self._flat: Tensor | None = None

    @property
    def head_config(self) -> HeadConfig | None:
        """The head that was chosen, before that the one asked for; None for none at all."""
        return sizes.chosen_head(self.search, self._largest)

    # ------------------------------------------------------------------------------------------------- checkpoints

    def state(self) -> dict[str, Any]:
        """State for a checkpoint: numbers, and copies of the fields to go back to while the search goes on."""
        return {
            "numbers": self.search.state(),
            "accepted": self._accepted,
            "fallback": self._fallback,
            "flat": self._flat,
        }

    def load_state(self, state: Any) -> None:
        """Counterpart of :meth:`state`.

        Raises:
            CheckpointError: it is not what :meth:`state` gives.
        """
        search = search_of(state)
        needed = {"accepted": search.trying, "fallback": search.phase in ("bands", "head")}
        if any(due and not isinstance(state.get(name), Mapping) for name, due in needed.items()):
            raise CheckpointError("the checkpoint lacks the field that its search would go back to; give another")
        self.search = search
        self._accepted, self._fallback, self._flat = state.get("accepted"), state.get("fallback"), state.get("flat")

    def shapes(self, extra: Any, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """``expected`` state of a model, in the shapes that the search of a checkpoint has given it.

        Args:
            extra: what the checkpoint carries beside the tensors; of another method's, nothing is known.
            expected: ``state_dict`` of the model as it is configured.

        Raises:
            CheckpointError: see :meth:`load_state`.
        """
        if not isinstance(extra, Mapping) or extra.get("method") != "sundae":
            return dict(expected)
        return shapes(search_of(extra.get("budget")), self._largest, expected)

    def prepare_head(self, extra: Mapping[str, Any], head: CompensationHead | None) -> CompensationHead | None:
        """The head of a model as a checkpoint has it, its values still to be loaded; None where it has none."""
        return heads.prepared(search_of(extra.get("budget")), self._largest, head)

    # ---------------------------------------------------------------------------------------------------- training

    def check(self, datamanager: SundaeDatamanager) -> None:
        """Check, before the first step, that there are views to judge by, and bytes for a primitive at all.

        Raises:
            ConfigError: no training view is held back, or the budget is too small.
        """
        # With a generator of its own: this is called after the random state of a checkpoint has been restored.
        origin, generator = torch.zeros(1, 3), torch.Generator()
        least = sizes.bytes_of(from_points(origin, origin, sh_degree=0, num_features=0, generator=generator), None)
        if self.config.max_bytes is not None and self.config.max_bytes < least:
            raise ConfigError(
                f"pruning.max-bytes is {self.config.max_bytes:,}, and one primitive takes {least}; give more"
            )
        if not datamanager.holdout_indices:
            raise ConfigError(
                "pruning.mode auto judges by training views that are held back, and there are none: give "
                "--pipeline.datamanager.holdout-every 8, less where there are fewer training views"
            )

    def after_step(self, model: SundaeModel, attributes: TrainingCallbackAttributes) -> None:
        """Act after a step of training, once densification has had its say.

        Raises:
            DataError: the budget is too small for one primitive, or the field cannot be scored.
        """
        config, search, step = self.config, self.search, model.schedule_step
        run = Run.of(model, attributes)
        if self._flat is not None:
            rest = run.params["features_rest"]
            self._flat = self._flat.to(rest.device)
            rest.data.mul_(~self._flat[:, None, None])
        started = time.perf_counter()
        if search.phase == "before" and step >= config.prune_at:
            self._begin(run)
        elif search.phase == "bands" and (self._trained(run) or self._time_is_up(run)):
            self._end_trial(run)
        elif search.phase in ("field", "head") and self._look_is_due(run):
            self._look(run)
        else:
            return
        refresh(model, run.optimizers)
        search.seconds += time.perf_counter() - started
        write(run, config, search)

    def finish(self, model: SundaeModel, attributes: TrainingCallbackAttributes) -> None:
        """Measure what came out against the target, and say whether it was reached."""
        config, search = self.config, self.search
        if search.phase == "before":
            CONSOLE.print("[yellow]Warning: training ended before the search for a budget began (pruning.prune-at)")
            return
        run = Run.of(model, attributes)
        end = self._look_at(run, run.measure(), "final", "reached")
        drop, stored, count = search.reference - end.psnr, end.bytes, model.num_points
        option, limit = wanted(config)
        cost = {"max_psnr_drop": drop, "max_bytes": stored, "max_primitives": count}[option]
        end.verdict = "reached" if cost <= limit else "missed"
        search.curve = [old for old in search.curve if old.phase != "final"] + [end]
        unfinished = ""
        if search.searching:
            # Steps of the schedule run ahead of training's own after a warm start.
            last = max(config.stop, model.schedule_step + config.search_every) - model.schedule_step + model.step
            unfinished = f" The search had not ended: train on to step {last}."
        CONSOLE.log(
            f"budget {option} {limit:,}: {end.verdict}. {count:,} of {search.before:,} primitives, "
            f"{megabytes(stored)}, harmonics of degree {run.degree}, "
            f"{'with' if search.head else 'no'} head, {drop:+.3f} dB lost on {search.views} held-back views.{unfinished}"
        )
        write(run, config, search)

    # ---------------------------------------------------------------------------------------------------- the steps

    def _begin(self, run: Run) -> None:
        model, search = run.model, self.search
        self._dropped(run.drop_nonfinite())
        # Densification has ended, and what it counted would not follow a field that goes back to more primitives.
        model.strategy_state.clear()
        model.strategy_state.update(model.strategy.initialize_state(scene_scale=1.0))
        search.began, search.before = model.schedule_step, model.num_points
        search.views = len(run.datamanager.holdout_indices)
        search.reference = run.measure()
        if search.reference == NO_PICTURE:
            raise DataError(
                "the warm-up field makes pictures that are not numbers: the training has diverged, go back to an earlier "
                "checkpoint"
            )
        search.target = search.reference - self.config.tolerated_drop
        CONSOLE.log(
            f"step {model.step}: warm-up field of {model.num_points:,} primitives, PSNR {search.reference:.3f} dB on "
            f"{search.views} held-back training views"
        )
        run.restart_rates(head=False)
        search.degree = run.degree
        if search.degree > 0 and not self._time_is_up(run):
            search.phase = "bands"
            self._fallback = run.snapshot(head=search.head)
            self._start_trial(run, search.degree)
        else:
            self._after_bands(run)

    def _after_bands(self, run: Run) -> None:
        if wanted(self.config)[0] != "max_psnr_drop":
            self._fit(run)
            self._done(run)
            return
        self.search.begin("field", run.model.num_points)
        value = run.measure()
        if self._clock(run).over:
            self._end_phase(run, value)
        else:
            self._cut_or_rest(run, value)

    def _time_is_up(self, run: Run) -> bool:
        """Whether this step has the last word; a run that ends before the search was meant to may be trained on."""
        return run.model.schedule_step >= self.config.stop and run.steps_left == 0

    def _clock(self, run: Run) -> _Clock:
        config, search, step = self.config, self.search, run.model.schedule_step
        # Half of the time is the head's, if it may join.
        head_to_come = search.phase == "field" and heads.may_pay(run, self._largest)
        deadline = (search.began + config.stop) // 2 if head_to_come else config.stop
        left = deadline - step if head_to_come else run.steps_left
        return _Clock(head_to_come, left, self._is_over(run, deadline, left))

    def _is_over(self, run: Run, deadline: int, left: int) -> bool:
        """Whether it is too late for something new, which has to be judged: what is left must do for the looks at it."""
        return run.model.schedule_step >= deadline or left < self.config.patience * self.config.search_every

    def _look_is_due(self, run: Run) -> bool:
        regular = (run.model.schedule_step - self.search.began) % self.config.search_every == 0
        return regular or (self.search.trying and self._time_is_up(run))

    def _look(self, run: Run) -> None:
        search, config, step = self.search, self.config, run.model.schedule_step
        head_to_come, left, over = self._clock(run)
        value = run.measure() if search.trying else self._measure_finite(run)
        verdict = search.judge(value, step, left, config.patience)
        point = self._look_at(run, value, search.phase, verdict)
        search.curve.append(point)
        CONSOLE.log(
            f"step {run.model.step}: {point.primitives:,} primitives, {value - search.target:+.3f} dB to the target, "
            f"{point.since_cut} steps after the cut: {verdict}"
        )
        writer.put_dict(
            name="Budget",
            scalar_dict={"primitives": point.primitives, "psnr": value, "to_target": value - search.target},
            step=run.model.step,
        )
        if verdict == "waiting":
            return
        if verdict == "rejected":
            self._restore(run, self._accepted)
            value = search.before_cut
        # A network that does not help, or that waits for its turn, is not waited for.
        tired = {"field": 1 if head_to_come else math.inf, "head": math.inf if search.cuts else 3}[search.phase]
        lost = search.head and value == NO_PICTURE  # no training brings its weights back
        if over or lost or search.looks >= tired * config.patience or search.rejected >= MAX_REJECTED:
            self._end_phase(run, value)
        else:
            self._cut_or_rest(run, value)

    def _cut_or_rest(self, run: Run, value: float) -> None:
        """Cut on as far as the margin allows; nothing where it allows nothing."""
        config, search = self.config, self.search
        count = search.next_count(value, config.num_neighbors + 1 if config.uses_graph else 1, config.patience)
        if count is None or run.steps_left < config.search_every:  # no look would judge it
            return
        self._accepted = run.snapshot(head=search.head)
        self._dropped(run.cut_to(count, config))
        search.cut(value, count, run.model.schedule_step)

    def _end_phase(self, run: Run, value: float) -> None:
        search, step = self.search, run.model.schedule_step
        too_late = self._is_over(run, self.config.stop, run.steps_left)
        if search.phase == "field" and heads.may_pay(run, self._largest) and not too_late:
            self._fallback = run.snapshot(head=search.head)
            search.begin("head", search.accepted)
            search.head_at, search.lost_at_join = step, search.steps_lost
            heads.join(run, search, self._largest, run.model.num_points)
            return
        if search.phase == "head":
            assert self._fallback is not None
            without = len(self._fallback["field"]["means"]["value"]) * run.row
            if value == NO_PICTURE or sizes.bytes_of(run.params, self.head_config) >= without:
                search.steps_lost = search.lost_at_join + step - search.head_at
                search.head = False
                self._restore(run, self._fallback)
        if not search.head and self._largest is not None:
            heads.drop(run, search)
        self._done(run)

    def _fit(self, run: Run) -> None:
        """The count that follows from a budget of bytes or primitives."""
        config, search, model = self.config, self.search, run.model
        row, count = run.row, min(config.max_primitives or model.num_points, model.num_points)
        if config.max_bytes is not None:
            count = min(config.max_bytes // row, model.num_points)
            if count == 0:
                raise DataError(
                    f"pruning.max-bytes is {config.max_bytes:,}, and one primitive takes {row:,}; give more"
                )
        if not heads.join(run, search, self._largest, count) and self._largest is not None:
            heads.drop(run, search)
        if config.max_bytes is not None:
            head = self.head_config if search.head else None
            count = accounting.rows_within(run.params, config.max_bytes, lambda rows: sizes.bytes_of(rows, head))
        if count < model.num_points:
            self._dropped(run.cut_to(count, config))
            search.cut_at = model.schedule_step
        search.accepted = model.num_points
        search.curve.append(self._look_at(run, run.measure(), "field", "cut"))

    def _done(self, run: Run) -> None:
        search, model = self.search, run.model
        search.phase = "done"
        self._accepted = self._fallback = None
        value = run.measure() if run.degree > 0 else NO_PICTURE
        if value > NO_PICTURE:
            least = value - FLAT_SHARE * self.config.tolerated_drop
            if run.steps_left == 0:  # nothing makes up for it any more
                least = max(least, min(value, search.target))
            self._flat = flatten(run, least)
            search.zeroed = int(self._flat.sum())
            CONSOLE.log(
                f"{search.zeroed:,} of {model.num_points:,} primitives look the same from everywhere: "
                "their harmonics are 0"
            )
        report = PruneReport(
            step=model.schedule_step,
            before=search.before,
            after=model.num_points,
            dropped_nonfinite=search.dropped_nonfinite,
            peak=model.pruning_state["peak"],
            seconds=search.seconds,
            tau=None,
            sigma=None,
            isolated=None,
        )
        CONSOLE.log(report.summary())
        record(model, run.attributes, report, model.step, before={}, after={})

    # ---------------------------------------------------------------------------------------------- the harmonics

    def _start_trial(self, run: Run, degree: int) -> None:
        """Train on from the warm-up field with the bands up to ``degree``."""
        search = self.search
        if degree < search.degree:
            leave_bands(run, degree)
            search.degree = degree
        search.cut_at = run.model.schedule_step

    def _trained(self, run: Run) -> bool:
        """Whether a trial has had as much training as all others."""
        return run.model.schedule_step - self.search.cut_at >= TRIAL_LOOKS * self.config.search_every

    def _end_trial(self, run: Run) -> None:
        search, tolerated = self.search, self.config.tolerated_drop
        if not self._trained(run):
            # The run ends in its midst. All bands have nothing to prove.
            if search.degrees:
                search.steps_lost += run.model.schedule_step - search.cut_at
                self._restore(run, self._accepted)
            self._leave_trials(run)
            return
        value = search.degrees[str(search.degree)] = self._measure_finite(run)
        top = max(int(name) for name in search.degrees)
        if search.degree == search.lowest_degree(top, tolerated):
            self._accepted = run.snapshot(head=search.head) if value > NO_PICTURE else self._fallback
        degree = search.next_degree(top, tolerated)
        if len(search.degrees) > 1 or value == NO_PICTURE:  # this trial, or the one that it has replaced
            search.steps_lost += run.model.schedule_step - search.cut_at
        if degree is not None:
            self._restore(run, self._fallback)
            self._start_trial(run, degree)
            return
        if search.degree != search.lowest_degree(top, tolerated) or value == NO_PICTURE:
            self._restore(run, self._accepted)
        self._leave_trials(run)

    def _leave_trials(self, run: Run) -> None:
        search = self.search
        self._fallback = None
        if search.degrees:
            levels = ", ".join(f"{name}: {value:.3f}" for name, value in search.degrees.items())
            CONSOLE.log(f"harmonics of degree {search.degree} (PSNR by degree after the same training: {levels} dB)")
        self._after_bands(run)

    # -------------------------------------------------------------------------------------------------- small things

    def _measure_finite(self, run: Run) -> float:
        """PSNR on the held-back views, without primitives that are not finite if these are what spoils it."""
        value = run.measure()
        dropped = run.drop_nonfinite() if value == NO_PICTURE else 0
        if not dropped:
            return value
        self._dropped(dropped)
        self.search.accepted = run.model.num_points
        return run.measure()

    def _dropped(self, count: int) -> None:
        self.search.dropped_nonfinite += count
        if count:
            CONSOLE.print(f"[yellow]Warning: dropped {count} primitives that were not finite")

    def _restore(self, run: Run, saved: dict[str, Snapshot] | None) -> None:
        run.restore(saved)
        self.search.degree = run.degree

    def _look_at(self, run: Run, psnr: float, phase: str, verdict: str) -> Point:
        return point_of(run, self.search, self._largest, psnr, phase=phase, verdict=verdict)
