"""The mean of the weights over the last steps of a training (stochastic weight averaging, Izmailov et al., UAI 2018).

A step sees one image, so the weights wander around what suits all of them; their mean lies nearer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState

EVERY = 10
"""Steps between two weights that count: neighbours differ by little."""


class Averaging(Extension):
    """Ends a training with the mean of field and head.

    Args:
        share: of the schedule, at its end, over which weights are averaged.
        settled_at: step of the schedule before which the number of primitives may change, so that nothing is averaged.
    """

    name = "averaging"

    def __init__(self, share: float, settled_at: float) -> None:
        self.share = share
        self.settled_at = settled_at
        self._mean: dict[str, Tensor] = {}
        self._count = 0
        self._restored = 0
        """Returns to a snapshot that the field had made when the mean began."""
        self._replaced: dict[str, Tensor] = {}
        """Weights of the last step, which the mean has replaced: a longer training goes on from them."""
        self._alone = True

    def state_dict(self) -> dict[str, Any]:
        """The mean so far, or the weights that it has replaced.

        Several ranks save neither, because each has those of its own shard: resumed, they go on from the mean.
        """
        if not self._alone:
            return {}
        return {"mean": self._mean, "count": self._count, "replaced": self._replaced}

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`."""
        self._mean, self._replaced = (
            {name: value.to(state.device) for name, value in saved.get(part, {}).items()}
            for part in ("mean", "replaced")
        )
        self._count, self._restored = int(saved.get("count", 0)), state.restored

    @torch.no_grad()
    def before_training(self, run: TrainingRun) -> None:
        """Put back the weights that a mean has replaced, so that two trainings end as one of their length."""
        self._alone = run.images_per_step == 1
        weights = dict(_weights(run.state))
        if self._alone and _shapes(weights) == _shapes(self._replaced):
            for name, value in weights.items():
                value.copy_(self._replaced[name])
        self._replaced = {}

    @torch.no_grad()
    def after_step(self, run: TrainingRun) -> None:
        """Count the weights if their turn has come; after the last step, put the mean in their place."""
        state, length, last = run.state, run.schedule_length, run.last_step
        if length is None or last is None or last + 1 < length:  # the first part of a run ends with its own weights
            return
        if state.schedule_step < self.settled_at or state.step < last - self.share * length:
            return
        weights = dict(_weights(state))
        if state.step % EVERY == 0:
            self._count_in(state, weights)
        if state.step == last and self._count > 0 and self._fits(state, weights):
            self._replaced = {name: value.clone() for name, value in weights.items()} if self._alone else {}
            for name, value in weights.items():
                value.copy_(self._mean[name])
            CONSOLE.log(f"step {state.step}: the weights are the mean of {self._count} of the last steps")
            self._mean, self._count = {}, 0

    def _count_in(self, state: FieldState, weights: Mapping[str, Tensor]) -> None:
        if not self._fits(state, weights):
            self._mean, self._count = {name: value.clone() for name, value in weights.items()}, 0
            self._restored = state.restored
        if not weights:  # a rank without primitives
            return
        self._count += 1
        torch._foreach_lerp_([self._mean[name] for name in weights], list(weights.values()), 1 / self._count)

    def _fits(self, state: FieldState, weights: Mapping[str, Tensor]) -> bool:
        """Whether these are weights of the same primitives and the same head as those of the mean."""
        return state.restored == self._restored and _shapes(self._mean) == _shapes(weights)


def _shapes(weights: Mapping[str, Tensor]) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in weights.items()}


def _weights(state: FieldState) -> Iterator[tuple[str, Tensor]]:
    """Parameters of the field and of the enabled head, by name."""
    for name, value in state.field.items():
        if value.numel() > 0:
            yield name, value.data
    if state.head_enabled and state.head is not None:
        for name, value in state.head.named_parameters():
            yield f"head.{name}", value.data
