"""The end of a training on few views, by held-out ones.

With few views a field soon learns what its images do not share, and other views get worse while training goes on. So the
views that the trials (:mod:`sundae_ns.training.trials`) have held out stay held out after the decision, and are measured again
and again, by the loss: SSIM still rises where PSNR already falls. Once the loss grows, the field goes back to the decision, and
trains on all views for as many steps as were best. It rests for the remaining ones. Test views are never used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE

from sundae_ns.gaussians.snapshot import Snapshot
from sundae_ns.training.averaging import EVERY, RunningMean, put, weights_of
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.heldout import mean_quality, measure_heldout
from sundae_ns.training.report import write_record
from sundae_ns.training.trials import Trials

MANY_VIEWS = 32
"""With as many training views nothing is held out after the decision: captures of 43 views and more gain to the end."""
WINDOW_SHARE = 0.02
"""Steps between two measurements, and over which weights are averaged for each, as a share of the schedule."""
LEAST_LOSS = 0.005
"""Growth of the loss over the best measurement that ends the watch, as a share."""
WATCHED_SHARE = 0.5
"""Longest watch, as a share of the steps after the decision; a field that has not lost by then trains on, on all views."""


@dataclass
class Progress:
    """Numbers of a watch; plain values, for checkpoints."""

    phase: str = "before"
    """before, watching, repeating (on all views), resting, or done (training goes on to the end)."""
    began: int = 0
    """Step of the schedule at which the phase began."""
    ends: int = 0
    """Step of the schedule at which it ends at the latest."""
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


def heldout_loss(decibels: float, similarity: float, ssim_weight: float) -> float:
    """Loss of images as in training after the prune: of the root of the mean squared error, and SSIM."""
    return float((1 - ssim_weight) * 10 ** (-decibels / 20) + ssim_weight * (1 - similarity))


class Stopping(Extension):
    """Ends the training of a field on few views where held-out ones ask for it.

    Args:
        trials: the decision about the head, which comes before.
        ssim_weight: weight of SSIM in the loss.
    """

    name = "stopping"

    def __init__(self, trials: Trials, ssim_weight: float) -> None:
        self.progress = Progress()
        self.ssim_weight = ssim_weight
        self._trials = trials
        self._start: dict[str, Snapshot] | None = None
        self._mean = RunningMean()

    # ------------------------------------------------------------------------------------------------- checkpoints

    def state_dict(self) -> dict[str, Any]:
        """Numbers and, while they are needed, the mean of the weights and the field to which the watch may return."""
        return {"numbers": asdict(self.progress), "start": self._start, **self._mean.state_dict()}

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`. A run that was saved before this extension existed trains on to its end."""
        decided = self._trials.progress.phase == "done"
        self.progress = Progress(**saved["numbers"]) if saved else Progress("done" if decided else "before")
        self._start, self._mean = saved.get("start"), RunningMean.of(saved, state.device)
        state.resting = self.progress.phase == "resting"

    # ---------------------------------------------------------------------------------------------------- training

    def before_training(self, run: TrainingRun) -> None:
        """Hold out the views of the watch again. After the end of its schedule, or on several GPUs, a run trains."""
        progress, state = self.progress, run.state
        if run.images_per_step > 1 and progress.phase != "before":  # a watch counts steps of one image
            progress.phase, state.resting = "done", False
        if progress.phase == "watching":
            run.hold_out(self._trials.held_out(run))
        self._wake(state)

    def after_step(self, run: TrainingRun) -> None:
        """Begin the watch, measure, go back, and rest."""
        progress, state = self.progress, run.state
        step = state.schedule_step
        if progress.phase == "before" and self._trials.progress.phase == "done":
            self._begin(run)
        elif progress.phase == "watching":
            self._count_in(state)
            if (step - progress.began) % self._window == 0:
                self._measure(run)
                if progress.lost:
                    self._go_back(run)
                elif step + self._window > progress.ends:
                    self._give_up(run)
        elif progress.phase == "repeating":
            if step > progress.ends - self._window:
                self._count_in(state)
            if step >= progress.ends:
                self._rest(run)
        self._wake(state)

    # ------------------------------------------------------------------------------------------------------ phases

    @property
    def _window(self) -> int:
        return max(round(WINDOW_SHARE * self._trials.progress.steps), 1)

    def _begin(self, run: TrainingRun) -> None:
        progress, state, views = self.progress, run.state, self._trials.held_out(run)
        step, left = state.schedule_step, self._trials.progress.steps - state.schedule_step
        watched = int(WATCHED_SHARE * left)
        # A field that comes from elsewhere has learnt all views: what it forgets of them is no overfitting.
        known = state.offset > 0
        if known or not views or len(run.view_indices()) >= MANY_VIEWS or watched < self._window:
            progress.phase = "done"
            return
        progress.phase, progress.began, progress.ends = "watching", step, step + watched
        self._start = state.snapshot(head=state.head_enabled)
        run.hold_out(views)
        CONSOLE.log(
            f"step {state.step}: {len(run.view_indices())} training views are few; {len(views)} stay held out, to see when "
            "training stops helping"
        )

    def _count_in(self, state: FieldState) -> None:
        if state.step % EVERY == 0:
            self._mean.count_in(weights_of(state))

    def _measure(self, run: TrainingRun) -> None:
        """Measure the held-out views with the mean of the window."""
        with self._mean.shown(weights_of(run.state)):
            views = measure_heldout(run)
        self._mean = RunningMean()
        decibels, similarity = mean_quality(views)
        self.progress.measured.append([heldout_loss(decibels, similarity, self.ssim_weight), decibels, similarity])
        run.log_scalars("Stopping", {"psnr": decibels, "ssim": similarity})

    def _go_back(self, run: TrainingRun) -> None:
        """Return to the field of the decision, and train on all views for as long as was best."""
        progress, state = self.progress, run.state
        length, step = progress.best * self._window, state.schedule_step
        (_, *best), (_, *now) = progress.measured[progress.best - 1], progress.measured[-1]
        CONSOLE.log(
            f"step {state.step}: the held-out views were best after {length:,} steps, {_text(best)}; now {_text(now)}. "
            "Going back, to train as long on all views"
        )
        assert self._start is not None
        state.restore(self._start)
        self._trials.undo(state, step - progress.began)
        progress.phase, progress.began, progress.ends = "repeating", step, step + length
        self._release(run, length)

    def _give_up(self, run: TrainingRun) -> None:
        """Train on, because nothing was lost."""
        CONSOLE.log(f"step {run.state.step}: the held-out views lose nothing; training goes on, on all views")
        self.progress.phase = "done"
        self._release(run, None)

    def _release(self, run: TrainingRun, length: int | None) -> None:
        """Serve all views, and record the watch."""
        self._start, self._mean = None, RunningMean()
        run.hold_out([])
        names = ("loss", "psnr", "ssim")
        record = {
            "held_out_views": self._trials.held_out(run),
            "steps_per_measurement": self._window,
            "measured": [dict(zip(names, figures, strict=True)) for figures in self.progress.measured],
            "steps_on_all_views": length,
        }
        write_record(run, "stopping.json", record)

    def _rest(self, run: TrainingRun) -> None:
        """Take the mean of the last window, and keep it to the end of the schedule."""
        weights = weights_of(run.state)
        if self._mean.fits(weights):
            put(self._mean.values, weights)
        self._mean = RunningMean()
        self.progress.phase, run.state.resting = "resting", True
        run.state.restored += 1  # what another mean has counted in since is no part of this one
        CONSOLE.log(f"step {run.state.step}: more training would harm other views; the remaining steps change nothing")

    def _wake(self, state: FieldState) -> None:
        """Train again after the end of the schedule: the user has asked for more."""
        if state.resting and state.schedule_step + 1 >= self._trials.progress.steps:
            state.resting = False


def _text(figures: list[float]) -> str:
    """PSNR and SSIM for the log."""
    decibels, similarity = figures
    return f"{decibels:.2f} dB, SSIM {similarity:.4f}"
