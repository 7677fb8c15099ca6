"""The decision how a field is finished (``head.mode auto``): plain, with a head, or with a head of more features.

A head gains where views are many and agree; where they are few or differ, it fits their differences. So some training views
are held out from shortly before the prune. From the pruned field, trials of one length follow in turn, each of a larger scene
than the one before, until one does not pay. Its held-out views are rendered with the mean of the weights over its last steps,
because the weights of a single step fit the last images best. The chosen field continues on all views; the steps of the others
are the cost. Test views are never used. After a warm start the field has seen the held-out views before, and only the steps
of the trials make it forget them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns.compensation import HeadConfig
from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians import FEATURES, initial_features
from sundae_ns.gaussians.snapshot import Snapshot
from sundae_ns.gaussians.surgery import replace_parameter
from sundae_ns.storage import megabytes
from sundae_ns.training.averaging import EVERY, RunningMean, weights_of
from sundae_ns.training.budget import bytes_of
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.heldout import HeldOutQuality, mean_quality, measure_heldout
from sundae_ns.training.report import write_record
from sundae_ns.training.schedulers import limit_rise, notify_pruned, postpone
from sundae_ns.training.warning import warn

ARMS = ("plain", "head", "features")
"""What is tried, in this order: no head, the head as configured, and one of more features. Each is larger than the last."""
MORE_FEATURES = 29
"""Features of the last arm: as many as are splatted without padding after the default 13."""
NAMES = {"plain": "no head", "head": "head", "features": f"head with {MORE_FEATURES} features"}
"""What the log calls them."""
TRIAL_STEPS = 1200
"""Length of a trial, if it is among the shares of the schedule below: shorter ones show too little of what a head gains."""
LEAST_TRIAL, MOST_TRIAL = 0.04, 0.05
"""Shortest and longest trial as shares of the schedule. All trials but that of the chosen arm cost at most a tenth of it."""
RISE_SHARE = 5 / 12
"""Share of a trial, at its beginning, over which the rate of the head may rise, so that the trial shows what it gains."""
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
"""Least PSNR that an arm must gain over a smaller one, dB. Two runs of one seed differ by as much."""
GAIN_PER_DOUBLING = 0.4
"""PSNR that an arm must gain for each doubling of the stored bytes, dB. Twice as many primitives gain about twice this at the
end of a run, and a trial shows a part of a gain."""
_DISABLED = "so it stays disabled; train longer, or force it with --pipeline.model.head.mode residual"


class Plan(NamedTuple):
    """The trials of a run: each arm is tried with each fold of held-out views."""

    folds: list[list[int]]
    """Held-out training views, by index."""
    length: int
    """Training steps of a trial."""
    arms: int
    """Number of arms."""

    @property
    def num_trials(self) -> int:
        """Most trials that there may be."""
        return self.arms * len(self.folds)

    @property
    def views(self) -> list[int]:
        """Held-out views of all folds."""
        return [index for fold in self.folds for index in fold]


def plan_trials(indices: Sequence[int], steps: int, arms: int = len(ARMS)) -> Plan:
    """Plan the trials of a run.

    Args:
        indices: of the training views, at least two.
        steps: length of the schedule.
        arms: number of arms.
    """
    few = len(indices) < FEW_VIEWS
    count = 2 if few else max(2, min(MOST_HELD_OUT, len(indices) // HELD_OUT_EVERY))
    # Evenly over the capture, because neighbours in a path look alike.
    chosen = [indices[(2 * i + 1) * len(indices) // (2 * count)] for i in range(count)]
    length = LEAST_TRIAL * steps / 2 if few else max(LEAST_TRIAL * steps, min(TRIAL_STEPS, MOST_TRIAL * steps))
    return Plan([[index] for index in chosen] if few else [chosen], max(round(length), 1), arms)


@dataclass
class Progress:
    """Numbers of a decision; plain values, for checkpoints."""

    phase: str = "before"
    """before, holding (views are held out), trials, or done."""
    decision: str = ""
    """The chosen arm."""
    reason: str = ""
    """Why it was chosen without trials."""
    steps: int = 0
    """Length of the schedule, noted when training starts: a resumed run may be longer or shorter, its trials may not."""
    trial: int = 0
    """Number of the current trial."""
    folds: int = 1
    """Number of trials of an arm."""
    bytes: list[int] = field(default_factory=list)
    """Stored bytes of the field with each arm's features and head, fp32."""
    began: int = 0
    """Step of the schedule at which the current trial began."""
    measured: list[list[list[float]]] = field(default_factory=list)
    """For each finished trial and held-out view: pixels, PSNR (dB), SSIM."""
    undone: int = 0
    """Steps since the first trial began that were taken back."""

    @property
    def arm(self) -> str:
        """Arm of the current trial; the chosen one after the trials, and plain before them."""
        return ARMS[self.trial // self.folds] if self.phase == "trials" else self.decision or "plain"

    @property
    def tried(self) -> tuple[str, ...]:
        """Arms whose trials have ended."""
        return ARMS[: len(self.measured) // self.folds]

    def qualities(self, arm: str) -> list[HeldOutQuality]:
        """Quality of the held-out views after the trials of an arm, over all folds."""
        first = ARMS.index(arm) * self.folds
        trials = self.measured[first : first + self.folds]
        return [HeldOutQuality(int(pixels), *figures) for trial in trials for pixels, *figures in trial]

    def best(self) -> str:
        """The largest tried arm that gains enough PSNR over the best smaller one for its bytes, and loses no SSIM."""
        best = "plain"
        for arm in self.tried[1:]:
            figures = (mean_quality(self.qualities(one)) for one in (best, arm))
            decibels, similarity = (b - a for a, b in zip(*figures, strict=True))
            doublings = math.log2(self.bytes[ARMS.index(arm)] / self.bytes[ARMS.index(best)])
            # Comparisons with figures that are not finite fail.
            if math.inf > decibels >= max(LEAST_GAIN, GAIN_PER_DOUBLING * doublings) and similarity >= 0:
                best = arm
        return best


class Trials(Extension):
    """Decides how the field is finished, and removes the head if it does not pay.

    Args:
        begins_at: step of the schedule after which the first trial begins: the number of primitives is settled.
        state: the field, whose head stays disabled until its trial.
    """

    name = "trials"

    def __init__(self, begins_at: int, state: FieldState) -> None:
        self.begins_at = begins_at
        self.progress = Progress()
        assert state.head is not None
        self._head = state.head.config
        self._arms = ARMS if self._head.num_features < MORE_FEATURES else ARMS[:2]
        self._plan: Plan | None = None
        self._start: dict[str, Snapshot] | None = None
        self._ends: dict[str, dict[str, Snapshot]] = {}
        self._mean = RunningMean()
        self._set_arm(state)

    # ------------------------------------------------------------------------------------------------- checkpoints

    def state_dict(self) -> dict[str, Any]:
        """Numbers and, during trials, the mean of the weights so far and copies of the fields to which they may return."""
        numbers = asdict(self.progress)
        return {"numbers": numbers, "start": self._start, "ends": self._ends, **self._mean.state_dict()}

    def prepare_loading(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Give head and features the width that they have in the checkpoint, or remove them.

        Raises:
            CheckpointError: the checkpoint carries no decision.
        """
        progress = _progress_of(saved)
        if progress.arm == "features":
            state.reshape_head(self._wide)
        elif progress.decision not in ("", "head"):
            state.remove_head()

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`.

        Raises:
            CheckpointError: the checkpoint carries no decision, or lacks a field to which its trials may return.
        """
        progress = _progress_of(saved)
        start, ends = saved.get("start"), saved.get("ends")
        # Trials of earlier versions had other arms, and no folds.
        complete = isinstance(start, Mapping) and isinstance(ends, Mapping) and "folds" in saved["numbers"]
        if progress.phase == "trials" and not complete:
            raise CheckpointError("the checkpoint lacks the fields that its trials would return to; give another")
        self.progress, self._start, self._ends = progress, start, dict(ends or {})
        self._mean = RunningMean.of(saved, state.device)
        self._set_arm(state)

    # ---------------------------------------------------------------------------------------------------- training

    def before_training(self, run: TrainingRun) -> None:
        """Decide at once where trials cannot; otherwise hold out the views of the phase."""
        views, progress = len(run.view_indices()), self.progress
        # A warm start skips the steps of the warm-up.
        progress.steps = progress.steps or (run.schedule_length or 0) + run.state.offset
        if progress.phase == "done":
            return
        if run.images_per_step > 1:  # also if one GPU has begun them: its copies are of the whole field
            wide = progress.arm == "features"
            self._settle(run, "features" if wide else "head", "trials need a single GPU")
        elif views < FEWEST_VIEWS:
            self._settle(run, "plain", f"{views} training views are too few to tell whether a head helps")
        elif progress.phase != "before":
            self._hold_out(run)
        elif run.last_step is not None and not self._fits(run):
            warn(f"training ends before the head can be tried, {_DISABLED}")

    def after_step(self, run: TrainingRun) -> None:
        """Hold out views, begin and end trials, decide."""
        progress, step = self.progress, run.state.schedule_step
        if progress.phase == "before" and step >= self.begins_at - HOLD_SHARE * progress.steps and self._fits(run):
            progress.phase = "holding"
            self._hold_out(run)
        if progress.phase == "holding" and step >= self.begins_at:
            plan = self._planned(run)
            CONSOLE.log(
                f"step {run.state.step}: is the head worth it? Up to {plan.num_trials} trials of {plan.length:,} steps; "
                f"{len(plan.views)} of {len(run.view_indices())} training views are held out"
            )
            progress.phase, progress.folds = "trials", len(plan.folds)
            progress.bytes = self._stored_bytes(run.state)
            limit_rise(run.state.schedulers, round(RISE_SHARE * plan.length))
            self._start = run.state.snapshot(head=True)
            self._begin(run)
        elif progress.phase == "trials":
            length = self._planned(run).length
            left = progress.began + length - step
            if left < MEAN_SHARE * length and run.state.step % EVERY == 0:
                self._mean.count_in(weights_of(run.state))
            if left <= 0:
                self._end(run)

    def finish(self, run: TrainingRun) -> None:
        """Warn if training ended before a decision."""
        if self.progress.phase != "done" and run.last_step is not None and run.last_step + 1 >= self._end_of(run):
            warn(f"training ended before the head could be tried, {_DISABLED}")

    def held_out(self, run: TrainingRun) -> list[int]:
        """Indices of the views that the chosen field has not seen since before its trial; none if there were no trials."""
        return [] if self.progress.reason else self._planned(run).folds[-1]

    def undo(self, state: FieldState, steps: int) -> None:
        """Let rates and the age of the head forget the last steps, after a return to the field before them."""
        postpone(state.schedulers, steps)
        self.progress.undone += steps
        state.undone = self.progress.undone

    # ------------------------------------------------------------------------------------------------------- trials

    def _planned(self, run: TrainingRun) -> Plan:
        if self._plan is None:
            self._plan = plan_trials(run.view_indices(), self.progress.steps, len(self._arms))
        return self._plan

    def _fits(self, run: TrainingRun) -> bool:
        """Whether the chosen arm can train on for the length of a trial."""
        plan = self._planned(run)
        return self._end_of(run) + run.state.offset > self.begins_at + (plan.num_trials + 1) * plan.length

    def _end_of(self, run: TrainingRun) -> int:
        """Number of training steps of the run, whose first part this training may be; 0 if it does not train."""
        return 0 if run.last_step is None else max(run.last_step + 1, run.schedule_length or 0)

    def _hold_out(self, run: TrainingRun) -> None:
        """Serve training views without the held-out ones of this phase."""
        plan, progress = self._planned(run), self.progress
        run.hold_out(plan.folds[progress.trial % progress.folds] if progress.phase == "trials" else plan.views)

    def _begin(self, run: TrainingRun) -> None:
        """Begin the current trial from the field as it is."""
        self._hold_out(run)
        self.progress.began = run.state.schedule_step
        if self.progress.arm == "features":
            self._widen(run.state)
        self._set_arm(run.state)
        if self.progress.arm != "plain":  # now: the prunes' extension acts before this one, so a step later
            notify_pruned(run.state.schedulers, run.state.step, run.source.total)

    def _stored_bytes(self, state: FieldState) -> list[int]:
        """Bytes of the field with each arm's features and head."""
        plain = {name: value for name, value in state.field.items() if name != FEATURES}
        sizes = [bytes_of(plain, None)]
        for head in (self._head, self._wide):
            features = torch.empty(state.field.num_primitives, head.num_features, device="meta")
            sizes.append(bytes_of({**plain, FEATURES: features}, head))
        return sizes

    @property
    def _wide(self) -> HeadConfig:
        """The head of the last arm."""
        return replace(self._head, num_features=MORE_FEATURES)

    def _widen(self, state: FieldState) -> None:
        """Begin anew with features and a head of the last arm."""
        assert state.head is not None
        state.head.resize(self._wide)
        state.optimizers["compensation"].state.clear()
        colors, generator = state.field["features_dc"].detach(), torch.Generator().manual_seed(0)
        features = initial_features(colors, MORE_FEATURES, generator)
        replace_parameter(state.field, state.optimizers, FEATURES, features, {})

    def _return_to(self, state: FieldState, saved: Mapping[str, Snapshot]) -> None:
        """Restore a field, with the head as configured if it has one."""
        assert state.head is not None
        if "head" in saved and state.head.config != self._head:
            state.head.resize(self._head)
        state.restore(saved)

    def _set_arm(self, state: FieldState) -> None:
        """Let the next steps train the arm of this phase."""
        arm = self.progress.arm
        # Not the step at which the arm began: a run that resumes on several GPUs counts other steps.
        state.head_starts_at = math.inf if arm == "plain" else self.begins_at
        state.trying, state.undone = self.progress.phase == "trials", self.progress.undone

    def _end(self, run: TrainingRun) -> None:
        """End the current trial; begin the next one from the same field, or decide."""
        progress, state, arm = self.progress, run.state, self.progress.arm
        progress.measured.append(self._measured(run))
        # What does not pay is not tried with more.
        if arm in progress.tried and arm != "plain" and (arm == self._arms[-1] or progress.best() != arm):
            self._decide(run)
            return
        self._ends[arm] = state.snapshot(head=arm != "plain")
        assert self._start is not None
        self._return_to(state, self._start)
        self.undo(state, state.schedule_step - progress.began)
        progress.trial += 1
        self._begin(run)

    def _measured(self, run: TrainingRun) -> list[list[float]]:
        """Figures of the held-out views with the mean of the weights, if there is one."""
        with self._mean.shown(weights_of(run.state)):
            views = [list(view) for view in measure_heldout(run)]
        self._mean = RunningMean()
        return views

    def _decide(self, run: TrainingRun) -> None:
        progress, state = self.progress, run.state
        decision, seen = progress.best(), all(progress.qualities(arm) for arm in progress.tried)
        if seen:
            self._report(run, decision)
        if decision != progress.arm:
            self._return_to(state, self._ends[decision])
        self._settle(run, decision, "" if seen else "masks leave no pixel of the held-out training views")

    def _report(self, run: TrainingRun, decision: str) -> None:
        """Log the figures of the arms, and the decision."""
        progress = self.progress
        figures = {arm: mean_quality(progress.qualities(arm)) for arm in progress.tried}
        texts = [
            f"{NAMES[arm]} {decibels:.2f} dB, SSIM {ssim:.4f}, {megabytes(size)}"
            for (arm, (decibels, ssim)), size in zip(figures.items(), progress.bytes, strict=False)
        ]
        CONSOLE.log(
            f"step {run.state.step}: held-out training views: {'; '.join(texts)}. Continuing: {NAMES[decision]}"
        )
        run.log_scalars("Trials", {f"psnr_{arm}": decibels for arm, (decibels, _) in figures.items()})

    def _settle(self, run: TrainingRun, decision: str, reason: str) -> None:
        """Take a decision, and serve all training views from now on."""
        progress = self.progress
        if reason:
            CONSOLE.log(f"the head is {'removed' if decision == 'plain' else 'enabled'}: {reason}")
        progress.phase, progress.decision, progress.reason = "done", decision, reason
        self._start, self._ends = None, {}
        run.hold_out([])
        self._set_arm(run.state)
        if decision == "plain":
            run.state.remove_head()
        write_record(run, "trials.json", self._record(run))

    def _record(self, run: TrainingRun) -> dict[str, Any]:
        """The decision and its figures."""
        progress = self.progress
        record: dict[str, Any] = {"decision": progress.decision, "reason": progress.reason, "step": run.state.step}
        if progress.reason:
            return record
        record |= {"held_out_views": self._planned(run).views, "steps_per_trial": self._planned(run).length, "arms": {}}
        for arm in progress.tried:
            views = progress.qualities(arm)
            decibels, similarity = mean_quality(views)
            record["arms"][arm] = {
                **{"psnr": decibels, "ssim": similarity, "bytes": progress.bytes[ARMS.index(arm)]},
                "views": [view._asdict() for view in views],
            }
        return record


def _progress_of(saved: Mapping[str, Any]) -> Progress:
    """The numbers of a checkpoint."""
    numbers = saved.get("numbers")
    if not isinstance(numbers, Mapping):
        raise CheckpointError(
            "the checkpoint is of a run with head.mode residual, features or off; give this mode with "
            "--pipeline.model.head.mode"
        )
    return Progress(**numbers)
