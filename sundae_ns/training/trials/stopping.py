"""The end of a training on few views, by held-out ones.

With few views a field soon learns what its images do not share, and other views get worse while training goes on. So
the views of the last trial (:mod:`sundae_ns.training.trials.head`) stay held out after the decision. They are measured
again and again, by the loss: SSIM still rises where PSNR already falls. Once the loss grows, the field goes back to the
decision, and trains on all views for as many steps as were best. Then training is paused. Test views are never used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.heldout import mean_quality
from sundae_ns.training.report import write_record
from sundae_ns.training.trials.engine import Trial, TrialEngine
from sundae_ns.training.trials.head import HeadTrials

MANY_VIEWS = 32
"""With as many training views nothing is held out after the decision: captures of 43 views and more gain to the end."""
WINDOW_SHARE = 0.02
"""Steps between two measurements, and over which weights are averaged for each, as a share of the schedule."""
LEAST_LOSS = 0.005
"""Growth of the loss over the best measurement that ends the watch, as a share."""
WATCHED_SHARE = 0.5
"""Longest watch, as a share of the steps after the decision; a field that has not lost by then trains on all views."""
_START = "decision"
"""Name of the copy of the field to which the watch may return."""


@dataclass
class StoppingProgress:
    """Numbers of a watch; plain values, for checkpoints."""

    phase: str = "before"
    """before, watching, repeating (on all views), paused, or done (training goes on to the end)."""
    ends: int = 0
    """Step of the schedule at which the watch ends at the latest."""
    measured: list[list[float]] = field(default_factory=list)
    """Figures of the held-out views after each window: loss, PSNR (dB), SSIM."""

    @property
    def best(self) -> int:
        """Number of windows after which the held-out views were best; 0 if none could be measured."""
        found = [math.inf if math.isnan(loss) else loss for loss, *_ in self.measured]
        return 1 + found.index(min(found)) if found else 0

    @property
    def lost(self) -> bool:
        """Whether the last measurement is worse than the best."""
        return bool(self.measured) and self.measured[-1][0] >= (1 + LEAST_LOSS) * self.measured[self.best - 1][0]


class EarlyStopping(Extension):
    """Ends the training of a field on few views where held-out ones ask for it.

    Args:
        decision: the decision about the head, which comes before.
        ssim_weight: weight of SSIM in the loss.
        engine: carries out the trials; ``decision`` saves its state.
    """

    name = "stopping"

    def __init__(self, decision: HeadTrials, ssim_weight: float, engine: TrialEngine) -> None:
        self.progress = StoppingProgress()
        self.ssim_weight = ssim_weight
        self._decision = decision
        self._engine = engine

    def state_dict(self) -> dict[str, Any]:
        """Numbers of the watch."""
        return {"numbers": asdict(self.progress)}

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`. A run that was saved before this extension existed trains on to its end.

        Raises:
            CheckpointError: the checkpoint lacks the field to which the watch may return.
        """
        if not saved:
            decided = self._decision.progress.phase == "done"
            self.progress = StoppingProgress("done" if decided else "before")
            return
        numbers = dict(saved["numbers"])
        if numbers.pop("began", None) is not None and numbers["phase"] == "resting":  # an earlier version
            numbers["phase"] = "paused"
        self.progress = StoppingProgress(**numbers)
        if self.progress.phase == "watching":
            self._engine.require(_START)
        elif self.progress.phase == "repeating":
            self._engine.require()

    def trains(self, state: FieldState) -> bool:
        """False while training is paused. After the end of the schedule it goes on: the user has asked for more."""
        return self.progress.phase != "paused" or state.schedule_step >= self._decision.progress.steps

    def before_training(self, run: TrainingRun) -> None:
        """Hold out the views of the watch again. On several GPUs a run trains to its end."""
        if self.progress.phase == "before":
            return
        if run.images_per_step > 1:  # a watch counts steps of one image
            self.progress.phase = "done"
            self._engine.end(run, self.name)
        self._engine.resume(run)

    def after_step(self, run: TrainingRun) -> None:
        """Begin the watch, measure, go back, and pause training."""
        progress = self.progress
        if progress.phase == "before" and self._decision.progress.phase == "done":
            self._begin(run)
        elif progress.phase in ("watching", "repeating") and self._engine.after_step(run):
            if progress.phase == "repeating":
                self._pause(run)
                return
            self._measure(run)
            if progress.lost:
                self._go_back(run)
            elif run.state.schedule_step + self._window > progress.ends:
                CONSOLE.log(f"step {run.state.step}: the held-out views lose nothing; training goes on, on all views")
                progress.phase = "done"
                self._engine.end(run, self.name)
                self._record(run, None)
            else:
                self._watch(run)

    @property
    def _window(self) -> int:
        return max(round(WINDOW_SHARE * self._decision.progress.steps), 1)

    def _begin(self, run: TrainingRun) -> None:
        progress, state, views = self.progress, run.state, self._decision.held_out(run)
        step = state.schedule_step
        watched = int(WATCHED_SHARE * (self._decision.progress.steps - step))
        # A field that comes from elsewhere has learnt all views: what it forgets of them is no overfitting.
        known = state.offset > 0
        if known or not views or len(run.view_indices()) >= MANY_VIEWS or watched < self._window:
            progress.phase = "done"
            return
        progress.phase, progress.ends = "watching", step + watched
        self._engine.keep(_START, state, head=state.head_enabled)
        self._watch(run)
        CONSOLE.log(
            f"step {state.step}: {len(run.view_indices())} training views are few; {len(views)} stay held out, to see "
            "when training stops helping"
        )

    def _watch(self, run: TrainingRun) -> None:
        """Train to the next measurement."""
        self._engine.start(run, Trial(self._window, self._decision.held_out(run), averaged=self._window))

    def _measure(self, run: TrainingRun) -> None:
        """Measure the held-out views with the mean of the window."""
        decibels, similarity = mean_quality(self._engine.measure(run))
        # As in training after the prune: the root of the mean squared error, and SSIM.
        loss = (1 - self.ssim_weight) * 10 ** (-decibels / 20) + self.ssim_weight * (1 - similarity)
        self.progress.measured.append([float(loss), decibels, similarity])
        run.log_scalars("Stopping", {"psnr": decibels, "ssim": similarity})

    def _go_back(self, run: TrainingRun) -> None:
        """Return to the field of the decision, and train on all views for as many steps as were best."""
        progress, length = self.progress, self.progress.best * self._window
        best, now = (
            f"{decibels:.2f} dB, SSIM {similarity:.4f}"
            for _, decibels, similarity in (progress.measured[progress.best - 1], progress.measured[-1])
        )
        CONSOLE.log(
            f"step {run.state.step}: the held-out views were best after {length:,} steps, {best}; now {now}. "
            "Going back, to train as long on all views"
        )
        self._engine.go_back(_START, run.state)
        self._engine.end(run, self.name)
        progress.phase = "repeating"
        self._engine.start(run, Trial(length, averaged=self._window))
        self._record(run, length)

    def _pause(self, run: TrainingRun) -> None:
        """Take the mean of the last window, and keep it to the end of the schedule."""
        self._engine.take_mean(run.state)
        self._engine.end(run, self.name)
        self.progress.phase = "paused"
        CONSOLE.log(f"step {run.state.step}: more training would harm other views; the remaining steps change nothing")

    def _record(self, run: TrainingRun, length: int | None) -> None:
        """Record the watch, and the number of steps on all views that follow it; None for all that are left."""
        names = ("loss", "psnr", "ssim")
        record = {
            "held_out_views": self._decision.held_out(run),
            "steps_per_measurement": self._window,
            "measured": [dict(zip(names, figures, strict=True)) for figures in self.progress.measured],
            "steps_on_all_views": length,
        }
        write_record(run, "stopping.json", record)
