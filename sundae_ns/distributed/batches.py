"""Training with R ranks: a step has R images, so gradients are averaged, rates grow, and there are fewer steps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any

import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor

from sundae_ns.training.run_length import RESETS, option, set_option, step_options


class SharedOptimizers(Optimizers):
    """nerfstudio's optimizers; gradients of the head, which every rank holds a copy of, are averaged over the ranks."""

    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """Average, then step. Collective."""
        if "compensation" in param_groups:
            average_gradients(self.parameters["compensation"])
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


@torch.no_grad()
def average_gradients(params: Iterable[Tensor]) -> None:
    """Average the gradients of replicated parameters over the ranks. Collective, in one message.

    Args:
        params: replicated parameters; the same ones have gradients on all ranks, without gaps in memory.
    """
    # In memory order, which is the same on all ranks whatever the order of the axes.
    gradients = [value.grad.as_strided((value.numel(),), (1,)) for value in params if value.grad is not None]
    if not gradients:
        return
    flat = torch.cat(gradients)
    dist.all_reduce(flat)
    flat /= dist.get_world_size()
    torch._foreach_copy_(gradients, flat.split([len(gradient) for gradient in gradients]))


def scale_rates(optimizers: Optimizers, names: Iterable[str], ranks: int) -> None:
    """Adapt Adam to batches of ``ranks`` images: rates times the square root, betas to that power.

    Source: Zhao et al., "On Scaling Up 3D Gaussian Splatting Training" (Grendel-GS), 2024. The rule is for primitives,
    which few images see. The head, whose weights every image uses, keeps its own rate.
    """
    for key in names:
        for group in optimizers.optimizers[key].param_groups:
            group.update(scaled_group(group, ranks))
        scheduler = optimizers.schedulers.get(key)
        for name in () if scheduler is None else ("base_lrs", "_last_lr"):
            setattr(scheduler, name, [rate * ranks**0.5 for rate in getattr(scheduler, name)])


def scaled_group(group: Mapping[str, Any], factor: float) -> dict[str, Any]:
    """Entries of an optimizer's group that change for batches ``factor`` times as large."""
    scaled = {name: group[name] * factor**0.5 for name in ("lr", "initial_lr") if name in group}
    if "betas" in group:
        # Rounded, so that a power and its root return the first number.
        scaled["betas"] = tuple(round(beta**factor, 12) for beta in group["betas"])
    return scaled


def shorten(config: Any, ranks: int) -> Any:
    """A copy of a configuration with all steps divided by ``ranks``: the same number of images in larger batches."""
    config = deepcopy(config)
    run = (
        "max_num_iterations",
        "schedule_length",
        "steps_per_save",
        "steps_per_eval_image",
        "steps_per_eval_all_images",
    )
    for name in [*run, *step_options(config)]:
        value = option(config, name)
        if value and name != RESETS:
            set_option(config, name, max(1, round(value / ranks)))
    return config
