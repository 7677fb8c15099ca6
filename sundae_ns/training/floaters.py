"""The extension that removes floaters in front of the cameras once, when the field has stopped growing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from sundae_ns.pruning.decision import FieldPruner
from sundae_ns.pruning.floaters import MOST, near_cameras
from sundae_ns.training.extension import Extension, TrainingRun
from sundae_ns.training.field_state import FieldState


class FloaterRemoval(Extension):
    """Removes what floats in front of a camera before anything is pruned, and before counts are compared.

    Afterwards no primitive is added, so what they showed is learnt by those that stay.

    Args:
        points: sparse points of the capture ``[P, 3]``; None if it has none, and then nothing is removed.
    """

    name = "floaters"

    def __init__(self, points: Tensor | None) -> None:
        self._points, self._done = points, points is None

    def state_dict(self) -> dict[str, Any]:
        """Whether it is done."""
        return {"done": self._done}

    def load_state_dict(self, state: FieldState, saved: Mapping[str, Any]) -> None:
        """Counterpart of :meth:`state_dict`; a run that was pruned before this extension existed is done."""
        self._done = self._points is None or bool(saved.get("done", state.pruning["num_prunes"] > 0))

    def needs_all(self, run: TrainingRun) -> bool:
        """Whether this is the last step at which the field grows, so that a saved warm-up has no floaters."""
        return not self._done and run.state.schedule_step + 1 >= run.state.densify_until

    def after_step(self, run: TrainingRun) -> None:
        """Remove floaters once."""
        state = run.state
        if not self.needs_all(run):
            return
        self._done = True
        assert self._points is not None
        views = [own.view for own in run.training_views()]
        if not views:
            return
        eyes = torch.stack([view.center for view in views])
        pruner = FieldPruner(state.field, state.optimizers, [state.densification])
        removed = pruner.drop(near_cameras(state.field["means"], eyes, self._points), at_most=MOST)
        if removed:
            CONSOLE.log(f"step {state.step}: removed {removed:,} floaters right in front of a camera")
