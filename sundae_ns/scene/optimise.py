"""The loop of the trainings outside of nerfstudio's: distillation and fine-tune."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from torch import Tensor
from torch.optim import Optimizer


def optimise(
    step: Callable[[int], object],
    optimizers: Mapping[str, Optimizer],
    steps: int,
    factor: Callable[[str, int], float],
    *,
    first: int = 0,
    on_step: Callable[[int], object] | None = None,
) -> bool:
    """Take steps, with learning rates that are a function of the step, so that a resumed training repeats them.

    ``factor`` is of the initial rate of an optimizer (by name) at a step: the present one, unless a group holds
    ``initial_lr``; ``first`` steps were taken before. ``on_step`` gets the number of steps taken; False stops, and is
    returned.
    """
    groups = [(name, group) for name, optimizer in optimizers.items() for group in optimizer.param_groups]
    for _, group in groups:
        group.setdefault("initial_lr", float(group["lr"]))
    for i in range(first, steps):
        for name, group in groups:
            rate = group["initial_lr"] * factor(name, i)
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)  # in place, where a recorded CUDA graph reads it
            else:
                group["lr"] = rate
        step(i)
        if on_step is not None and on_step(i + 1) is False:
            return False
    return True


def rate_factor(step: int, steps: int) -> float:
    """Share of the peak rate at a step: a short rise, because Adam has no moments yet, then half a cosine to 0."""
    rise = max(round(0.05 * steps), 1)
    if step < rise:
        return (step + 1) / (rise + 1)
    return 0.5 * (1 + math.cos(math.pi * (step - rise) / max(steps - rise, 1)))
