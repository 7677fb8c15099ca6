"""The engine of trials: keep copies of a field, train for some steps, measure held-out views, go back or go on.

It holds all of the state of a trial, so that a run resumes in the middle of one. The policies decide:
:mod:`sundae_ns.training.trials.count`, :mod:`sundae_ns.training.trials.head` and
:mod:`sundae_ns.training.trials.stopping`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch

from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians import FEATURES, initial_features
from sundae_ns.gaussians.surgery import replace_parameter
from sundae_ns.training.averaging import AVERAGED_EVERY, RunningMean, weights_of
from sundae_ns.training.extension import TrainingRun
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.heldout import HeldOutQuality, measure_heldout
from sundae_ns.training.schedulers import notify_pruned, put_restarts, restarts


@dataclass(frozen=True)
class Trial:
    """Options of a trial; plain values, for checkpoints."""

    length: int
    """Training steps."""
    held_out: list[int] = field(default_factory=list)
    """Indices of the training views that are held out."""
    averaged: float = 0
    """Steps at its end over which weights are averaged; the mean is measured. 0 measures the last weights."""
    num_features: int | None = None
    """Width of the features: 0 disables the head, another width begins with a fresh one. None changes nothing."""
    counts: bool = True
    """Whether its field goes on in any case; that of others is :attr:`FieldState.provisional`."""
    began: int = 0
    """Step of the schedule at which it began; the engine sets it."""


class TrialEngine:
    """Trials on the field of a run, one after another.

    Args:
        head_starts_at: step of the schedule after which an enabled head corrects images.
    """

    def __init__(self, head_starts_at: float = -math.inf) -> None:
        self.trial: Trial | None = None
        """The current trial."""
        self.kept: dict[str, dict[str, Any]] = {}
        """Copies of the field by name: a :meth:`FieldState.snapshot`, and the number of ``counted`` steps before it."""
        self.taken_back = 0
        """Steps after which the field went back to before them."""
        self._held: dict[str, list[int]] = {}
        self._head_starts_at = head_starts_at
        self._mean = RunningMean()

    def state_dict(self) -> dict[str, Any]:
        """Plain values and tensors for a checkpoint."""
        trial = None if self.trial is None else asdict(self.trial)
        return {"trial": trial, "kept": self.kept, "taken_back": self.taken_back, **self._mean.state_dict()}

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Take over a :meth:`state_dict`. Missing entries stand for no trial."""
        trial = saved.get("trial")
        self.trial = None if trial is None else Trial(**trial)
        self.kept, self.taken_back = dict(saved.get("kept", {})), int(saved.get("taken_back", 0))
        self._mean = RunningMean.of(saved, state.device)
        self._mark(state)

    def require(self, *names: str, trial: bool = True) -> None:
        """Check after loading that copies of the field are kept under these names, and that there is a trial.

        Raises:
            CheckpointError: one is missing, as in a checkpoint of an earlier version.
        """
        if (trial and self.trial is None) or not all(isinstance(self.kept.get(name), Mapping) for name in names):
            raise CheckpointError("the checkpoint lacks a field that its trials would return to; give another")

    def start(self, run: TrainingRun, trial: Trial) -> None:
        """Start a trial from the present field."""
        state = run.state
        self.trial, self._mean = replace(trial, began=state.schedule_step), RunningMean()
        self.resume(run)
        if trial.num_features is not None:
            self.enable_head(state, trial.num_features > 0)
        if trial.num_features:
            _widen(state, trial.num_features)
            # Now: the extension that prunes acts before this one, so it would be a step later.
            notify_pruned(state.schedulers, state.step, run.source.total)
        self._mark(state)

    def hold(self, run: TrainingRun, policy: str, views: Sequence[int]) -> None:
        """Hold out views for the trials to come of a policy, in place of those before; none ends it.

        While a trial is trained, its own views are held out and no others.
        """
        self._held[policy] = list(views)
        self.resume(run)

    def resume(self, run: TrainingRun) -> None:
        """Hold out the views of the current trial, or else those of the trials to come."""
        coming = {view for views in self._held.values() for view in views}
        run.hold_out(sorted(coming) if self.trial is None else self.trial.held_out)

    def after_step(self, run: TrainingRun) -> bool:
        """Average the weights if it is due; returns whether the current trial has been trained."""
        trial, state = self.trial, run.state
        assert trial is not None
        left = trial.began + trial.length - state.schedule_step
        if left < trial.averaged and state.step % AVERAGED_EVERY == 0:
            self._mean.count_in(weights_of(state))
        return left <= 0

    def measure(self, run: TrainingRun, *, with_fitted: bool = False) -> list[HeldOutQuality]:
        """Quality of the held-out views with the mean of the weights, if there is one; the next mean begins anew."""
        with self._mean.shown(weights_of(run.state)):
            views = measure_heldout(run, with_fitted=with_fitted)
        self._mean = RunningMean()
        return views

    def take_mean(self, state: FieldState) -> None:
        """Continue with the mean of the weights, if there is one."""
        self._mean.replace(weights_of(state))
        self._mean = RunningMean()
        state.restored += 1  # another mean must not contain the weights before it

    def keep(self, name: str, state: FieldState, *, head: bool) -> None:
        """Keep a copy of the field, and of the head if asked for, until the trials end."""
        self.kept[name] = {
            "counted": state.schedule_step - self.taken_back,
            "taken_back": self.taken_back,
            "pruning": dict(state.pruning),
            "restarts": restarts(state.schedulers),
            **state.snapshot(head=head),
        }

    def go_back(self, name: str, state: FieldState) -> None:
        """Continue with a kept copy of the field, its learning rates and its counted steps."""
        kept = self.kept[name]
        state.restore(kept)
        peak = {name: value for name, value in state.pruning.items() if name == "peak"}  # goes on through all trials
        state.pruning.update({**kept["pruning"], **peak})
        self.taken_back = state.schedule_step - kept["counted"]
        put_restarts(state.schedulers, kept["restarts"], self.taken_back - kept["taken_back"])

    def end(self, run: TrainingRun, policy: str) -> None:
        """End the trials of a policy: forget the kept copies, and serve its views from the next step on."""
        self.trial, self.kept, self._mean = None, {}, RunningMean()
        self.hold(run, policy, [])
        self._mark(run.state)

    def enable_head(self, state: FieldState, enabled: bool) -> None:
        """Enable or disable the head."""
        # Not from this step on: a run that is resumed on several GPUs counts other steps.
        state.head_starts_at = self._head_starts_at if enabled else math.inf

    def _mark(self, state: FieldState) -> None:
        state.provisional = self.trial is not None and not self.trial.counts


def _widen(state: FieldState, num_features: int) -> None:
    """Give the field fresh features and a fresh head of a width that they do not have."""
    assert state.head is not None
    if state.head.config.num_features == num_features:
        return
    state.head.resize(replace(state.head.config, num_features=num_features))
    state.optimizers["compensation"].state.clear()
    colors, generator = state.field["features_dc"].detach(), torch.Generator().manual_seed(0)
    features = initial_features(colors, num_features, generator)
    replace_parameter(state.field, state.optimizers, FEATURES, features, {})
