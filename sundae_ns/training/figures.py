"""Loss, its terms and metrics of a step, as nerfstudio's trainer passes them to its writers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sundae_ns.training.field_state import FieldState


def detached(result: tuple[Tensor, Mapping[str, Any], Mapping[str, Any]]) -> tuple[Any, ...]:
    """Loss, its terms, and metrics without their graph.

    nerfstudio holds them until the next step. Trials that resize the head in between need the graph to be gone.
    """
    loss, *figures = result
    values = [
        {name: one.detach() if isinstance(one, Tensor) else one for name, one in part.items()} for part in figures
    ]
    return loss.detach(), *values


@torch.no_grad()
def figures_without_training(pipeline: Any, state: FieldState, step: int) -> tuple[Any, ...]:
    """Loss, its terms, and metrics of the image of a step that trains nothing.

    Args:
        pipeline: nerfstudio's, of the run.
        state: the field in training; it stays as it is, and so do the random generators.
        step: training step.
    """
    focal = state.trained_focal
    with torch.random.fork_rng([state.device] if state.device.type == "cuda" else []):
        _, terms, metrics = pipeline.get_train_loss_dict(step)
    state.trained_focal = focal
    return detached((torch.stack(list(terms.values())).sum(), terms, metrics))
