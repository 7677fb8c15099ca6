"""Means of the weights over steps of a training (stochastic weight averaging, Izmailov et al., UAI 2018).

A step sees one image, so the weights wander around what suits all of them; their mean lies nearer.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from sundae_ns.train.state import Callback, TrainingRun, TrainingState

_log = logging.getLogger(__name__)

AVERAGED_EVERY = 10  # Steps between two weights that count: neighbours differ by little


class RunningMean:
    """The mean of ``count`` weights so far, by name; they are counted in one after another."""

    def __init__(self, values: Mapping[str, Tensor] | None = None, count: int = 0) -> None:
        self.values, self.count = dict(values or {}), count

    @classmethod
    def of(cls, saved: Mapping[str, Any], device: torch.device) -> RunningMean:
        """The mean of a :meth:`state_dict`; a new one if there is none in it."""
        values = {name: value.to(device) for name, value in saved.get("mean", {}).items()}
        return cls(values, int(saved.get("count", 0)))

    def state_dict(self) -> dict[str, Any]:
        """Entries for a checkpoint."""
        return {"mean": self.values, "count": self.count}

    @torch.no_grad()
    def count_in(self, weights: Mapping[str, Tensor]) -> None:
        """Count weights in; those of other shapes begin a new mean."""
        if not self.fits(weights):
            self.values, self.count = {name: value.clone() for name, value in weights.items()}, 0
        if not weights:  # a rank without Gaussians
            return
        self.count += 1
        torch._foreach_lerp_([self.values[name] for name in weights], list(weights.values()), 1 / self.count)

    @torch.no_grad()
    def replace(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Put the mean, if one fits, in the place of weights; returns their copies, which are empty without a mean."""
        copies = {name: value.clone() for name, value in weights.items()} if self.fits(weights) else {}
        for name in copies:
            weights[name].copy_(self.values[name])
        return copies

    @contextmanager
    def applied(self, weights: Mapping[str, Tensor]) -> Iterator[None]:
        """Put the mean, if one fits, in the place of weights for the length of a block."""
        copies = self.replace(weights)
        try:
            yield
        finally:
            RunningMean(copies, len(copies)).replace(weights)

    def fits(self, weights: Mapping[str, Tensor]) -> bool:
        """Whether there is a mean, and of weights of these names and shapes."""
        same_names = self.count > 0 and self.values.keys() == weights.keys()
        return same_names and all(value.shape == self.values[name].shape for name, value in weights.items())


def weights_of(state: TrainingState) -> dict[str, Tensor]:
    """Weights of the field and of the enabled head, by name; changes in place change the field."""
    weights = {name: value.data for name, value in state.gaussians.items() if value.numel() > 0}
    if state.head_enabled and state.head is not None:
        weights |= {f"head.{name}": value.data for name, value in state.head.named_parameters()}
    return weights


class Averaging(Callback):
    """Ends a training with the mean of field and head, a first part of one too if it ends within the share.

    ``share`` of the schedule, at its end, is averaged, but nothing before the step ``settled_at``, until which the
    number of Gaussians may change.
    """

    name = "averaging"

    def __init__(self, share: float, settled_at: float) -> None:
        self.share, self.settled_at = share, settled_at
        self._mean = RunningMean()
        self._restored = 0  # Returns to a snapshot that the field had made when the mean began
        self._replaced: dict[str, Tensor] = {}  # Weights of the last step, from which a longer training continues
        self._alone = True

    def state_dict(self) -> dict[str, Any]:
        """The mean so far, or the weights that it has replaced; neither of several ranks, as each has its shard."""
        return {**self._mean.state_dict(), "replaced": self._replaced} if self._alone else {}

    def load_state_dict(self, state: TrainingState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`."""
        self._mean, self._restored = RunningMean.of(saved, state.device), state.restored
        self._replaced = {name: value.to(state.device) for name, value in saved.get("replaced", {}).items()}

    def before_training(self, run: TrainingRun) -> None:
        """Put back the weights that a mean has replaced, so that two trainings end as one of their length."""
        state, length, last = run.state, run.schedule_length, run.last_step
        if length is not None and last is not None:
            end = max(last, length - 1)  # a part that ends earlier ends with its own weights
            state.averages_from = max(end - self.share * length, self.settled_at - state.offset)
        self._alone = run.images_per_step == 1
        RunningMean(self._replaced, 1).replace(weights_of(state))
        self._replaced = {}

    def after_step(self, run: TrainingRun) -> None:
        """Count the weights if their turn has come; after the last step, put the mean in their place."""
        state, last = run.state, run.last_step
        if state.step < state.averages_from:
            self._mean = RunningMean()  # a run that was stopped in its last part may be resumed for a longer one
            return
        if state.restored != self._restored:
            self._mean, self._restored = RunningMean(), state.restored
        if state.step % AVERAGED_EVERY == 0:
            self._mean.count_in(weights_of(state))
        if state.step == last and (replaced := self._mean.replace(weights_of(state))):
            _log.info(f"step {state.step}: the weights are the mean of {self._mean.count} of the last steps")
            self._replaced = replaced if self._alone else {}
            if last >= run.schedule_length - 1:  # after a part, the mean continues with the rest of the run
                self._mean = RunningMean()
