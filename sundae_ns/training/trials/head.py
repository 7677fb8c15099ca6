"""The decision how a field is finished (``head.mode auto``): plain, with a head, or with a head of more features.

A head gains where views are many and agree; where they are few or differ, it fits their differences. So some training
views are held out from shortly before the prune. From the pruned field, trials of one length follow in turn, each of a
larger scene than the one before, until one does not pay. The mean of the weights over its last steps renders the
held-out views: the weights of a single step fit the last images best. The chosen field continues on all views; the
steps of the others are the cost. Test views are never used. After a warm start the field has seen the held-out views
before, and only the steps of the trials make it forget them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians import FEATURES
from sundae_ns.storage.accounting import megabytes, stored_bytes
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.heldout import HeldOutQuality, from_values, mean_quality
from sundae_ns.training.report import write_record
from sundae_ns.training.schedulers import limit_rise
from sundae_ns.training.trials.engine import Trial, TrialEngine
from sundae_ns.training.warning import warn

CANDIDATES = ("plain", "head", "features")
"""In the order of their trials: no head, the head as configured, one of more features. Each is larger than the last."""
MORE_FEATURES = 29
"""Features of the last candidate: as many as are splatted without padding after the default 13."""
NAMES = {"plain": "no head", "head": "head", "features": f"head with {MORE_FEATURES} features"}
"""What the log calls them."""
TRIAL_STEPS = 1200
"""Length of a trial, if it is between the shares below: shorter ones show too little of what a head gains."""
LEAST_TRIAL, MOST_TRIAL = 0.04, 0.05
"""Shortest and longest trial as shares of the schedule. All but those of the chosen candidate cost at most a tenth."""
RISE_SHARE = 5 / 12
"""Share of a trial, at its beginning, over which the rate of the head may rise, so that it shows what it gains."""
MEAN_SHARE = 0.25
"""Share of a trial, at its end, over which weights are averaged for the verdict."""
HOLD_SHARE = 0.1
"""Share of the schedule for which views are held out before the first trial, so that the field forgets them."""
HELD_OUT_EVERY = 8
"""One of this many training views is held out, at least two and at most :data:`MOST_HELD_OUT`."""
MOST_HELD_OUT = 16
"""Most held-out views."""
FEWEST_VIEWS = 6
"""Fewer training views cannot judge a trial; the field is then finished plain."""
FEW_VIEWS = 12
"""With fewer training views, two are held out in turn, for trials of half the length."""
LEAST_GAIN = 0.1
"""Least PSNR that a candidate must gain over a smaller one, dB. Two runs of one seed differ by as much."""
GAIN_PER_DOUBLING = 0.4
"""PSNR that a candidate must gain for each doubling of the stored bytes, dB. Twice as many primitives gain about twice
this at the end of a run, and a trial shows a part of a gain."""
_DISABLED = "so it stays disabled; train longer, or force it with --pipeline.model.head.mode residual"


@dataclass(frozen=True)
class TrialPlan:
    """The trials of a run: each candidate is tried with each fold of held-out views."""

    folds: list[list[int]]
    """Held-out training views, by index."""
    length: int
    """Training steps of a trial."""

    @property
    def views(self) -> list[int]:
        """Held-out views of all folds."""
        return [index for fold in self.folds for index in fold]


def least_gain(doublings: float) -> float:
    """PSNR that a larger scene must gain, dB.

    Args:
        doublings: of the stored bytes that it takes.
    """
    return max(LEAST_GAIN, GAIN_PER_DOUBLING * doublings)


def spread_views(indices: Sequence[int], count: int, half: int) -> list[int]:
    """Views evenly over a capture, because neighbours in a path look alike.

    Args:
        indices: of the training views.
        count: number of views.
        half: 0 or 1: two choices of the same number that share no view.
    """
    return [indices[(2 * i + half) * len(indices) // (2 * count)] for i in range(count)]


def plan_trials(indices: Sequence[int], steps: int) -> TrialPlan:
    """Plan the trials of a run.

    Args:
        indices: of the training views, at least two.
        steps: length of the schedule.
    """
    few = len(indices) < FEW_VIEWS
    chosen = spread_views(indices, 2 if few else max(2, min(MOST_HELD_OUT, len(indices) // HELD_OUT_EVERY)), 1)
    length = LEAST_TRIAL * steps / 2 if few else max(LEAST_TRIAL * steps, min(TRIAL_STEPS, MOST_TRIAL * steps))
    return TrialPlan([[index] for index in chosen] if few else [chosen], max(round(length), 1))


@dataclass
class HeadTrialProgress:
    """Numbers of a decision; plain values, for checkpoints."""

    phase: str = "before"
    """before, holding (views are held out), trials, or done."""
    decision: str = ""
    """The chosen candidate."""
    reason: str = ""
    """Why it was chosen without trials."""
    steps: int = 0
    """Length of the schedule when training started: a resumed run may be longer or shorter, its trials may not."""
    folds: int = 1
    """Number of trials of a candidate."""
    bytes: list[int] = field(default_factory=list)
    """Stored bytes of the field with each candidate's features and head, fp32."""
    measured: list[list[list[float]]] = field(default_factory=list)
    """For each finished trial and held-out view: pixels, PSNR (dB), SSIM."""

    @property
    def candidate(self) -> str:
        """Candidate of the current trial; the chosen one after the trials, and plain before them."""
        return CANDIDATES[len(self.measured) // self.folds] if self.phase == "trials" else self.decision or "plain"

    @property
    def tried(self) -> tuple[str, ...]:
        """Candidates whose trials have ended."""
        return CANDIDATES[: len(self.measured) // self.folds]

    def qualities(self, candidate: str) -> list[HeldOutQuality]:
        """Quality of the held-out views after the trials of a candidate, over all folds."""
        first = CANDIDATES.index(candidate) * self.folds
        trials = self.measured[first : first + self.folds]
        return [view for trial in trials for view in from_values(trial)]

    @property
    def best(self) -> str:
        """The largest tried candidate that gains enough over the best smaller one, and loses no SSIM."""
        best = "plain"
        for candidate in self.tried[1:]:
            doublings = math.log2(self.bytes[CANDIDATES.index(candidate)] / self.bytes[CANDIDATES.index(best)])
            if pays(self.qualities(best), self.qualities(candidate), doublings):
                best = candidate
        return best


def is_enough(psnr: float, ssim: float, doublings: float) -> bool:
    """Whether gains in PSNR (dB) and SSIM pay for doublings of the bytes; those that are not finite do not."""
    return math.inf > psnr >= least_gain(doublings) and ssim >= 0


def pays(smaller: Sequence[HeldOutQuality], larger: Sequence[HeldOutQuality], doublings: float = 0.0) -> bool:
    """Whether a larger scene gains enough PSNR over a smaller one, and loses no SSIM.

    Args:
        smaller, larger: quality of the held-out views.
        doublings: of the stored bytes that the larger one takes.
    """
    decibels, similarity = (b - a for a, b in zip(*map(mean_quality, (smaller, larger)), strict=True))
    return is_enough(decibels, similarity, doublings)


class HeadTrials(Extension):
    """Decides how the field is finished, and removes the head if it does not pay.

    Args:
        begins_at: step of the schedule after which the first trial begins: the number of primitives is settled.
        state: the field, whose head stays disabled until its trial.
        engine: carries out the trials.
        verdict: whether trials of counts have found that the head pays, or None if they leave it to these; called once
            the field has been pruned. None without such trials.
    """

    name = "trials"

    def __init__(
        self,
        begins_at: int,
        state: FieldState,
        engine: TrialEngine,
        verdict: Callable[[], bool | None] | None = None,
    ) -> None:
        self.begins_at = begins_at
        self._verdict_of_counts = verdict
        self.progress = HeadTrialProgress()
        assert state.head is not None
        self._head = state.head.config
        self._wide = replace(self._head, num_features=MORE_FEATURES)
        self._candidates = CANDIDATES if self._head.num_features < MORE_FEATURES else CANDIDATES[:2]
        self._plan: TrialPlan | None = None
        self._engine = engine
        engine.enable_head(state, False)

    def state_dict(self) -> dict[str, Any]:
        """Numbers of the decision, and the state of the engine."""
        return {"numbers": asdict(self.progress), "engine": self._engine.state_dict()}

    def prepare_loading(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Give head and features the width that they have in the checkpoint, or remove them.

        Raises:
            CheckpointError: the checkpoint carries no decision.
        """
        progress = _progress_of(saved)
        if progress.candidate == "features":
            state.reshape_head(self._wide)
        elif progress.decision not in ("", "head"):
            state.remove_head()

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`.

        Raises:
            CheckpointError: the checkpoint carries no decision, or lacks a field to which its trials may return.
        """
        self.progress = _progress_of(saved)
        # Earlier versions noted the steps taken back among the numbers; their trials cannot be resumed.
        before = {"taken_back": saved["numbers"].get("undone", 0)}
        self._engine.load_state_dict(state, saved.get("engine", before))
        if self.progress.phase == "trials":
            self._engine.require("start", *self.progress.tried)
        self._engine.enable_head(state, self.progress.candidate != "plain")

    def before_training(self, run: TrainingRun) -> None:
        """Decide at once where trials cannot; otherwise hold out the views of the phase."""
        views, progress = len(run.view_indices()), self.progress
        # A warm start skips the steps of the warm-up.
        progress.steps = progress.steps or (run.schedule_length or 0) + run.state.offset
        if progress.phase == "done":
            return
        if run.images_per_step > 1:  # also if one GPU has begun them: its copies are of the whole field
            wide = progress.candidate == "features"
            self._settle(run, "features" if wide else "head", "trials need a single GPU")
        elif views < FEWEST_VIEWS:
            self._settle(run, "plain", f"{views} training views are too few to tell whether a head helps")
        elif progress.phase == "holding":
            self._engine.hold(run, self.name, self._planned(run).views)
        elif progress.phase == "trials":
            self._engine.resume(run)
        elif run.last_step is not None and not self._fits(run):
            warn(f"training ends before the head can be tried, {_DISABLED}")

    def after_step(self, run: TrainingRun) -> None:
        """Hold out views, begin and end trials, decide."""
        progress, step = self.progress, run.state.schedule_step
        if progress.phase == "before" and step >= self.begins_at - HOLD_SHARE * progress.steps and self._fits(run):
            progress.phase = "holding"
            self._engine.hold(run, self.name, self._planned(run).views)
        # Trials of counts come first: the field of one of them is not yet the one that is finished.
        counts = self._verdict_of_counts
        ready = self._engine.trial is None and (counts is None or run.state.pruning["num_prunes"] > 0)
        if progress.phase == "holding" and step >= self.begins_at and ready:
            verdict = None if counts is None else counts()
            if verdict is None:
                self._begin(run)
            else:
                self._settle(run, "head" if verdict else "plain", "the trials of counts have shown what it gains")
        elif progress.phase == "trials" and self._engine.after_step(run):
            self._end_trial(run)

    def finish(self, run: TrainingRun) -> None:
        """Warn if training ended before a decision."""
        last = run.last_step
        if self.progress.phase != "done" and last is not None and last + 1 >= (run.schedule_length or 0):
            warn(f"training ended before the head could be tried, {_DISABLED}")

    def held_out(self, run: TrainingRun) -> list[int]:
        """Indices of the views that the chosen field has not seen since before its trial; none without trials."""
        return [] if self.progress.reason else self._planned(run).folds[-1]

    def _planned(self, run: TrainingRun) -> TrialPlan:
        if self._plan is None:
            self._plan = plan_trials(run.view_indices(), self.progress.steps)
        return self._plan

    def _fits(self, run: TrainingRun) -> bool:
        """Whether the chosen candidate can train on for the length of a trial."""
        plan = self._planned(run)
        trials = len(self._candidates) * len(plan.folds) + 1
        # This training may be the first part of the run.
        steps = 0 if run.last_step is None else max(run.last_step + 1, run.schedule_length or 0)
        return steps + run.state.offset > self.begins_at + trials * plan.length

    def _begin(self, run: TrainingRun) -> None:
        plan, progress, state = self._planned(run), self.progress, run.state
        CONSOLE.log(
            f"step {state.step}: is the head worth it? Up to {len(self._candidates) * len(plan.folds)} trials of "
            f"{plan.length:,} steps; {len(plan.views)} of {len(run.view_indices())} training views are held out"
        )
        progress.phase, progress.folds = "trials", len(plan.folds)
        plain = {name: value for name, value in state.field.items() if name != FEATURES}
        progress.bytes = [stored_bytes(plain, None)]
        for head in (self._head, self._wide):
            features = torch.empty(state.field.num_primitives, head.num_features, device="meta")
            progress.bytes.append(stored_bytes({**plain, FEATURES: features}, head))
        limit_rise(state.schedulers, round(RISE_SHARE * plan.length))
        self._engine.keep("start", state, head=True)
        self._engine.hold(run, self.name, [])
        self._start_trial(run)

    def _start_trial(self, run: TrainingRun) -> None:
        plan, progress = self._planned(run), self.progress
        width = {"plain": 0, "head": self._head.num_features, "features": MORE_FEATURES}[progress.candidate]
        fold = plan.folds[len(progress.measured) % progress.folds]
        # A trial is too short for what helps in the long run, so its steps do not count yet.
        trial = Trial(plan.length, fold, averaged=MEAN_SHARE * plan.length, num_features=width, counts=False)
        self._engine.start(run, trial)

    def _end_trial(self, run: TrainingRun) -> None:
        """Measure the current trial; start the next one from the same field, or decide."""
        progress, state, candidate = self.progress, run.state, self.progress.candidate
        progress.measured.append([list(view) for view in self._engine.measure(run)])
        # What does not pay is not tried with more.
        last = candidate == self._candidates[-1] or progress.best != candidate
        if candidate in progress.tried and candidate != "plain" and last:
            self._decide(run, candidate)
            return
        self._engine.keep(candidate, state, head=candidate != "plain")
        self._engine.go_back("start", state)
        self._start_trial(run)

    def _decide(self, run: TrainingRun, trained: str) -> None:
        """Continue with the best candidate; ``trained`` is the one that the field is."""
        progress, decision = self.progress, self.progress.best
        figures: dict[str, Any] = {}
        for candidate in progress.tried:
            views = progress.qualities(candidate)
            decibels, similarity = mean_quality(views)
            size = progress.bytes[CANDIDATES.index(candidate)]
            shown = [view._asdict() for view in views]
            figures[candidate] = {"psnr": decibels, "ssim": similarity, "bytes": size, "views": shown}
        seen = all(one["views"] for one in figures.values())
        if seen:
            text = "; ".join(
                f"{NAMES[name]} {one['psnr']:.2f} dB, SSIM {one['ssim']:.4f}, {megabytes(one['bytes'])}"
                for name, one in figures.items()
            )
            CONSOLE.log(f"step {run.state.step}: held-out training views: {text}. Continuing: {NAMES[decision]}")
            run.log_scalars("Trials", {f"psnr_{name}": one["psnr"] for name, one in figures.items()})
        if decision != trained:
            self._engine.go_back(decision, run.state)
        self._settle(run, decision, "" if seen else "masks leave no pixel of the held-out training views", figures)

    def _settle(self, run: TrainingRun, decision: str, reason: str, figures: Mapping[str, Any] | None = None) -> None:
        """Take a decision, serve all training views from now on, and record it."""
        progress, state = self.progress, run.state
        if reason:
            CONSOLE.log(f"the head is {'removed' if decision == 'plain' else 'enabled'}: {reason}")
        progress.phase, progress.decision, progress.reason = "done", decision, reason
        self._engine.end(run, self.name)
        self._engine.enable_head(state, decision != "plain")
        if decision == "plain":
            state.remove_head()
        record: dict[str, Any] = {"decision": decision, "reason": reason, "step": state.step}
        if not reason:
            plan = self._planned(run)
            record |= {"held_out_views": plan.views, "steps_per_trial": plan.length, "arms": figures}
        write_record(run, "trials.json", record)


def _progress_of(saved: Mapping[str, Any]) -> HeadTrialProgress:
    """The numbers of a checkpoint.

    Raises:
        CheckpointError: there are none.
    """
    numbers = saved.get("numbers")
    if not isinstance(numbers, Mapping):
        raise CheckpointError(
            "the checkpoint is of a run with head.mode residual, features or off; give this mode with "
            "--pipeline.model.head.mode"
        )
    known = {one.name for one in fields(HeadTrialProgress)}
    return HeadTrialProgress(**{name: value for name, value in numbers.items() if name in known})
