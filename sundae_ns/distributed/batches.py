"""A step of R ranks sees R pictures: gradients are averaged, rates grow, and there are fewer steps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any

import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor


class SharedOptimizers(Optimizers):
    """nerfstudio's optimizers, where some groups are copies of which every rank has one: their gradients are averaged."""

    replicated: tuple[str, ...] = ("compensation",)

    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """Average, then step. Collective."""
        for name in self.replicated:
            if name in param_groups:
                average_gradients(self.parameters[name])
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


@torch.no_grad()
def average_gradients(params: Iterable[Tensor]) -> None:
    """Give copies of parameters the mean of their gradients over the ranks. Collective, in one message.

    Args:
        params: the same on all ranks, and the same of them with a gradient; gradients lie in memory without gaps.
    """
    # As they lie in memory, whatever the order of their axes, which is the same on all ranks.
    gradients = [value.grad.as_strided((value.numel(),), (1,)) for value in params if value.grad is not None]
    if not gradients:
        return
    flat = torch.cat(gradients)
    dist.all_reduce(flat)
    flat /= dist.get_world_size()
    torch._foreach_copy_(gradients, flat.split([len(gradient) for gradient in gradients]))


def scale_rates(optimizers: Optimizers, names: Iterable[str], ranks: int) -> None:
    """Adapt Adam to batches of ``ranks`` pictures: rates by the square root, both betas to that power.

    Source: Zhao et al., "On Scaling Up 3D Gaussian Splatting Training" (Grendel-GS), 2024. It is a rule for primitives, each of
    which few pictures see. A head, whose weights all take part in every picture, keeps its own (``docs/distributed.md``).

    Args:
        optimizers: by name of the group.
        names: the groups to adapt, parameters of the field.
        ranks: pictures of a step.
    """
    for key in names:
        for group in optimizers.optimizers[key].param_groups:
            group.update(scaled_group(group, ranks))
        scheduler = optimizers.schedulers.get(key)
        for name in () if scheduler is None else ("base_lrs", "_last_lr"):
            setattr(scheduler, name, [rate * ranks**0.5 for rate in getattr(scheduler, name)])


def scaled_group(group: Mapping[str, Any], factor: float) -> dict[str, Any]:
    """Entries of an optimizer's group that change where batches are ``factor`` times as large."""
    scaled = {name: group[name] * factor**0.5 for name in ("lr", "initial_lr") if name in group}
    if "betas" in group:
        # Rounded, so that a power and its root give the number that they began with.
        scaled["betas"] = tuple(round(beta**factor, 12) for beta in group["betas"])
    return scaled


def shorten(config: Any, ranks: int) -> Any:
    """A copy of a configuration whose steps are divided by ``ranks``: as many pictures, in larger batches.

    Args:
        config: ``SundaeTrainerConfig``.
        ranks: pictures of a step.
    """
    config = deepcopy(config)
    model = config.pipeline.model
    steps: tuple[tuple[Any, str], ...] = (
        (config, "max_num_iterations steps_per_save steps_per_eval_image steps_per_eval_all_images"),
        (model.pruning, "prune_at round_every start stop every"),
        (model.head, "start_at"),
        (model, "warmup_length refine_every resolution_schedule sh_degree_interval stop_screen_size_at stop_split_at"),
    )
    for owner, names in steps:
        for name in names.split():
            value = getattr(owner, name)
            if value:
                setattr(owner, name, max(1, round(value / ranks)))
    for group in config.optimizers.values():
        scheduler = group["scheduler"]
        if scheduler is not None:
            scheduler.max_steps = max(1, round(scheduler.max_steps / ranks))
            scheduler.warmup_steps = round(getattr(scheduler, "warmup_steps", 0) / ranks)
    return config
