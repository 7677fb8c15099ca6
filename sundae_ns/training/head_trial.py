"""The decision whether a field gets a head (``head.mode auto``).

A head gains where views are many and agree; where they are few or differ, it fits their differences. So some training
views are held out from shortly before the prune. From the pruned field two trials of one length follow, without and with
the head. The held-out views choose one, and it continues on all views; the steps of the other are the cost. Test views are
never used.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns.errors import CheckpointError
from sundae_ns.evaluation import without_nan
from sundae_ns.gaussians.snapshot import Snapshot, module_snapshot, restore, restore_module, snapshot
from sundae_ns.storage.atomic import write_text
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.heldout import HeldOutQuality, mean_quality, measure_heldout
from sundae_ns.training.schedulers import postpone

TRIAL_SHARE = 0.05
"""Length of a trial as a share of the schedule."""
HOLD_SHARE = 0.1
"""Share of the schedule for which views are held out before the first trial, so that the field forgets them."""
HELD_OUT_EVERY = 8
"""One of this many training views is held out, at least two and at most :data:`MOST_HELD_OUT`."""
MOST_HELD_OUT = 16
"""Most held-out views."""
FEWEST_VIEWS = 6
"""Fewer training views cannot tell whether a head helps; the field then gets none."""
FEW_VIEWS = 12
"""With fewer training views, two are held out in turn, for trials of half the length."""
LEAST_GAIN = 0.1
"""PSNR that a head must gain, dB. Two runs of one seed differ by as much."""


class Trials(NamedTuple):
    """The trials of a run. Each fold of held-out views has two: without the head, then with it."""

    folds: list[list[int]]
    """Held-out training views, by index."""
    length: int
    """Training steps of a trial."""

    @property
    def number(self) -> int:
        """Number of trials."""
        return 2 * len(self.folds)

    @property
    def views(self) -> list[int]:
        """Held-out views of all folds."""
        return [index for fold in self.folds for index in fold]


def plan_trials(indices: Sequence[int], steps: int) -> Trials:
    """Trials of a run.

    Args:
        indices: of the training views, at least two.
        steps: length of the schedule.
    """
    few = len(indices) < FEW_VIEWS
    count = 2 if few else max(2, min(MOST_HELD_OUT, len(indices) // HELD_OUT_EVERY))
    # Evenly over the capture, because neighbours in a path look alike.
    chosen = [indices[(2 * i + 1) * len(indices) // (2 * count)] for i in range(count)]
    length = max(round(TRIAL_SHARE * steps / (2 if few else 1)), 1)
    return Trials([[index] for index in chosen] if few else [chosen], length)


@dataclass
class Progress:
    """Numbers of a decision; plain values, for checkpoints."""

    phase: str = "before"
    """before, holding (views are held out), trials, or done."""
    decision: str = ""
    """head or none, once taken."""
    reason: str = ""
    """Why it was taken without trials."""
    steps: int = 0
    """Length of the schedule, noted when training starts: a resumed run may be longer or shorter, its trials may not."""
    trial: int = 0
    """Number of the current trial; those with the head are odd."""
    began: int = 0
    """Step of the schedule at which the current trial began."""
    measured: list[list[list[float]]] = field(default_factory=list)
    """For each finished trial and held-out view: pixels, PSNR (dB), SSIM."""

    def qualities(self, *, head: bool) -> list[HeldOutQuality]:
        """Quality of all held-out views after the trials with the head, or after those without."""
        return [HeldOutQuality(*view) for trial in self.measured[int(head) :: 2] for view in trial]  # type: ignore[arg-type]


class HeadTrial(Extension):
    """Decides whether the field gets its head, and removes the head if not.

    Args:
        begins_at: step of the schedule after which the first trial begins: field and number of primitives are settled.
        state: the field, whose head stays disabled until its trial.
    """

    name = "head_trial"

    def __init__(self, begins_at: int, state: FieldState) -> None:
        self.begins_at = begins_at
        self.progress = Progress()
        self._plan: Trials | None = None
        self._start: dict[str, Snapshot] | None = None
        self._bare: dict[str, Snapshot] | None = None
        state.head_starts_at = math.inf

    # ------------------------------------------------------------------------------------------------- checkpoints

    def state_dict(self) -> dict[str, Any]:
        """Numbers and, during trials, copies of the fields to which they may return."""
        return {"numbers": asdict(self.progress), "start": self._start, "bare": self._bare}

    def prepare_loading(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Remove the head if the checkpoint has none.

        Raises:
            CheckpointError: the checkpoint carries no decision.
        """
        if _progress_of(saved).decision == "none":
            state.remove_head()

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`.

        Raises:
            CheckpointError: the checkpoint carries no decision, or lacks the fields of its trials.
        """
        progress = _progress_of(saved)
        needed = {"start": progress.phase == "trials", "bare": progress.phase == "trials" and progress.trial % 2 == 1}
        if any(due and not isinstance(saved.get(name), Mapping) for name, due in needed.items()):
            raise CheckpointError("the checkpoint lacks the field that its head trial would return to; give another")
        self.progress, self._start, self._bare = progress, saved.get("start"), saved.get("bare")
        enabled = progress.decision == "head" or (progress.phase == "trials" and progress.trial % 2 == 1)
        state.head_starts_at = progress.began if enabled else math.inf

    # ---------------------------------------------------------------------------------------------------- training

    def before_training(self, run: TrainingRun) -> None:
        """Decide at once where trials cannot; otherwise hold out the views of the phase."""
        views, progress = len(run.view_indices()), self.progress
        # A warm start skips the steps of the warm-up.
        progress.steps = progress.steps or (run.num_steps or 0) + run.state.offset
        if progress.phase == "before":
            if run.images_per_step > 1:
                self._settle(run, "head", "trials need a single GPU")
            elif views < FEWEST_VIEWS:
                self._settle(run, "none", f"{views} training views are too few to tell whether it helps")
        elif progress.phase != "done":
            self._hold_out(run)

    def after_step(self, run: TrainingRun) -> None:
        """Hold out views, begin and end trials, decide."""
        progress, step = self.progress, run.state.schedule_step
        if progress.phase == "before" and step >= self.begins_at - HOLD_SHARE * progress.steps:
            if not self._fits(run):
                return
            progress.phase = "holding"
            self._hold_out(run)
        if progress.phase == "holding" and step >= self.begins_at:
            progress.phase = "trials"
            trials = self._trials(run)
            CONSOLE.log(
                f"step {run.state.step}: is the head worth it? {trials.number} trials of {trials.length:,} steps, without "
                f"and with it; {len(trials.views)} of {len(run.view_indices())} training views are held out"
            )
            self._start = _copies(run.state)
            self._begin(run)
        elif progress.phase == "trials" and step - progress.began >= self._trials(run).length:
            self._end(run)

    def finish(self, run: TrainingRun) -> None:
        """Warn if training ended before a decision."""
        if self.progress.phase != "done":
            CONSOLE.print(
                "[yellow]Warning: training ended before the head could be tried, so it stays disabled; train longer, or "
                "force it with --pipeline.model.head.mode residual",
                soft_wrap=True,
            )

    # ------------------------------------------------------------------------------------------------------- trials

    def _trials(self, run: TrainingRun) -> Trials:
        if self._plan is None:
            self._plan = plan_trials(run.view_indices(), self.progress.steps)
        return self._plan

    def _fits(self, run: TrainingRun) -> bool:
        """Whether as many steps as the trials take are left after them."""
        if run.last_step is None:
            return False
        trials = self._trials(run)
        return run.last_step + run.state.offset >= self.begins_at + 2 * trials.number * trials.length

    def _hold_out(self, run: TrainingRun) -> None:
        """Serve training views without the held-out ones of this phase."""
        trials, progress = self._trials(run), self.progress
        run.hold_out(trials.folds[progress.trial // 2] if progress.phase == "trials" else trials.views)

    def _begin(self, run: TrainingRun) -> None:
        """Begin the current trial from the field as it is."""
        self._hold_out(run)
        state = run.state
        self.progress.began = state.schedule_step
        state.head_starts_at = state.schedule_step if self.progress.trial % 2 else math.inf

    def _end(self, run: TrainingRun) -> None:
        progress, state = self.progress, run.state
        mend = "decide by hand with --pipeline.model.head.mode residual or off"
        progress.measured.append([list(view) for view in measure_heldout(run, mend=mend)])
        if progress.trial % 2 == 0:
            self._bare = _copies(state)
        progress.trial += 1
        if progress.trial == self._trials(run).number:
            self._decide(run)
            return
        assert self._start is not None
        _restore(state, self._start)
        postpone(state.schedulers, state.schedule_step - progress.began)
        self._begin(run)

    def _decide(self, run: TrainingRun) -> None:
        progress = self.progress
        without, with_head = (mean_quality(progress.qualities(head=head)) for head in (False, True))
        gain = [b - a for a, b in zip(without, with_head, strict=True)]
        # A gain that is not finite does not pay.
        pays = gain[0] >= LEAST_GAIN and gain[1] >= 0
        CONSOLE.log(
            f"step {run.state.step}: the head gains {gain[0]:+.2f} dB and {gain[1]:+.4f} SSIM on held-out training views "
            f"({without[0]:.2f} dB, {without[1]:.4f} without it): it is {'enabled' if pays else 'removed'}"
        )
        run.log_scalars("Head", {"gain_psnr": gain[0], "gain_ssim": gain[1], "enabled": int(pays)})
        if not pays:
            assert self._bare is not None
            _restore(run.state, self._bare)
        self._settle(run, "head" if pays else "none", "")

    def _settle(self, run: TrainingRun, decision: str, reason: str) -> None:
        """Take a decision, and serve all training views from now on."""
        progress, state = self.progress, run.state
        if reason:
            CONSOLE.log(f"the head is {'enabled' if decision == 'head' else 'removed'} without a trial: {reason}")
            progress.began = self.begins_at
        progress.phase, progress.decision, progress.reason = "done", decision, reason
        self._start = self._bare = None
        run.hold_out([])
        if decision == "none":
            state.remove_head()
        else:
            state.head_starts_at = progress.began
        self._record(run)

    def _record(self, run: TrainingRun) -> None:
        """Write the decision and its figures to ``head.json`` in the run's folder."""
        if run.folder is None:
            return
        progress = self.progress
        record: dict[str, Any] = {"decision": progress.decision, "reason": progress.reason, "step": run.state.step}
        if progress.measured:
            trials = self._trials(run)
            record |= {"held_out_views": trials.views, "steps_per_trial": trials.length}
            for name, head in (("without_head", False), ("with_head", True)):
                views = progress.qualities(head=head)
                record[name] = {
                    **dict(zip(("psnr", "ssim"), mean_quality(views))),
                    "views": [v._asdict() for v in views],
                }
        run.folder.mkdir(parents=True, exist_ok=True)
        write_text(run.folder / "head.json", json.dumps(without_nan(record), indent=2) + "\n")


def _copies(state: FieldState) -> dict[str, Snapshot]:
    """Copies of field and head with the states of their optimizers."""
    assert state.head is not None
    return {
        "field": snapshot(state.field, state.optimizers),
        "head": module_snapshot(state.head.parameters(), state.optimizers["compensation"]),
    }


def _restore(state: FieldState, saved: Mapping[str, Snapshot]) -> None:
    """Return to :func:`_copies`."""
    assert state.head is not None
    restore(state.field, state.optimizers, saved["field"])
    restore_module(state.head.parameters(), state.optimizers["compensation"], saved["head"])


def _progress_of(saved: Mapping[str, Any]) -> Progress:
    """The numbers of a checkpoint."""
    numbers = saved.get("numbers")
    if not isinstance(numbers, Mapping):
        raise CheckpointError(
            "the checkpoint is of a run with head.mode residual, features or off; give this mode with "
            "--pipeline.model.head.mode"
        )
    return Progress(**numbers)
