"""Learning-rate schedules: exponential or cosine decay that can restart at the prune.

nerfstudio's exponential decay leaves numpy numbers in its state, which a weights-only ``torch.load`` refuses from torch
2.6 on. This one holds Python floats only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler

DecayShape = Literal["exponential", "cosine"]

SPARSE = 15_000
"""In a pruned field of fewer primitives centres move faster: on surfaces, they are the root of the quotient farther
apart."""
MOST_FACTOR = 5.0
"""Largest factor on the rate of the centres, that of 600 primitives; nothing smaller was measured."""


@dataclass
class Decay:
    """Multiplier of the learning rate as a function of the step. Its state is plain numbers.

    Before the prune the rate decays from 1 to ``final`` over ``max_steps``; with ``hold_until_prune`` it stays at 1.
    The prune may restart it: a rise over ``warmup_steps``, then a decay from ``restart`` to ``final`` at ``max_steps``.
    ``shape`` is exponential, or half a cosine (Loshchilov & Hutter 2017, "SGDR").
    """

    final: float
    max_steps: int
    restart: float | None
    hold_until_prune: bool
    warmup_steps: int
    shape: DecayShape = "exponential"
    pruned_at: int | None = None
    after_prune: float = 1.0
    """Factor on the rate after the prune."""
    ends_at: int | None = None
    """Step at which the decay after the prune ends, in place of ``max_steps``."""

    def __call__(self, step: int) -> float:
        """The multiplier at ``step``."""
        start, begin, end, rise, factor = 1.0, 0, self.max_steps, 1.0, 1.0
        if self.pruned_at is None:
            if self.hold_until_prune:
                return 1.0
        elif self.restart is not None and step >= self.pruned_at:
            start, begin, factor = self.restart, self.pruned_at, self.after_prune
            end = self.max_steps if self.ends_at is None else self.ends_at
            rise = min((step - begin + 1) / (self.warmup_steps + 1), 1.0)
        t = (step - begin) / max(end - begin, 1)
        t = min(max(t, 0.0), 1.0)
        if self.shape == "cosine":
            return float(rise * factor * (self.final + (start - self.final) * (1.0 + math.cos(math.pi * t)) / 2.0))
        return float(rise * factor * start ** (1.0 - t) * self.final**t)


@dataclass
class PruneAwareDecayConfig(SchedulerConfig):
    """Decay that the prune can restart."""

    _target: type = field(default_factory=lambda: PruneAwareDecay)
    """target class to instantiate"""
    lr_final: float = 1.6e-6
    """Learning rate at max_steps."""
    max_steps: int = 30000
    """Step at which the decay ends."""
    lr_restart: float | None = None
    """Learning rate right after the prune, where the decay restarts; None does not restart it."""
    hold_until_prune: bool = False
    """Whether the rate stays constant until pruning has ended and the head is enabled; the decay starts there."""
    warmup_steps: int = 0
    """Steps over which the rate rises after the prune."""
    shape: DecayShape = "exponential"
    """Decay by an exponential, or along half a cosine."""


class PruneAwareDecay(Scheduler):
    """Builds the torch scheduler of a :class:`PruneAwareDecayConfig`."""

    config: PruneAwareDecayConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LRScheduler:
        """A ``LambdaLR`` whose state holds Python numbers only."""
        config = self.config
        restart = None if config.lr_restart is None else config.lr_restart / lr_init
        hold, rise = config.hold_until_prune, config.warmup_steps
        return LambdaLR(
            optimizer, Decay(config.lr_final / lr_init, config.max_steps, restart, hold, rise, config.shape)
        )


def sparse_factor(primitives: int) -> float:
    """Factor on the rate of the centres of a pruned field."""
    return min(max(1.0, math.sqrt(SPARSE / max(primitives, 1))), MOST_FACTOR)


def notify_pruned(
    schedulers: Mapping[str, LRScheduler],
    step: int,
    primitives: int,
    *,
    last: bool = True,
    ends_at: int | None = None,
) -> None:
    """Restart every :class:`Decay` among ``schedulers`` at ``step``; later calls change nothing.

    Args:
        schedulers: by name.
        step: training step of the prune.
        primitives: number of primitives that were kept. With fewer than :data:`SPARSE` the rate of the centres rises.
        last: False while pruning goes on or the head is still disabled; rates that hold until then are left alone.
        ends_at: training step at which they reach their final value, as for a trial; None for that of the run.
    """
    for name, scheduler, decay in _decays(schedulers):
        if decay.pruned_at is None and (last or not decay.hold_until_prune):
            decay.pruned_at, decay.ends_at = step, ends_at
            if name == "means":
                decay.after_prune = sparse_factor(primitives)
            _apply(scheduler)


Restarts = dict[str, tuple[int | None, float, int | None]]
"""By name: the step at which a decay has restarted, its factor since, and the step at which it ends."""


def restarts(schedulers: Mapping[str, LRScheduler]) -> Restarts:
    """The restarts of every :class:`Decay`; plain values, for checkpoints."""
    return {name: (decay.pruned_at, decay.after_prune, decay.ends_at) for name, _, decay in _decays(schedulers)}


def put_restarts(schedulers: Mapping[str, LRScheduler], saved: Restarts, later: int) -> None:
    """Put back the :func:`restarts`, this many steps later, as for a trial that starts again."""
    for name, scheduler, decay in _decays(schedulers):
        at, decay.after_prune, decay.ends_at = saved[name]
        decay.pruned_at = None if at is None else at + later
        _apply(scheduler)


def limit_rise(schedulers: Mapping[str, LRScheduler], steps: int) -> None:
    """Let every :class:`Decay` that has not restarted rise over at most this many steps when it does."""
    for _, _, decay in _decays(schedulers):
        if decay.pruned_at is None:
            decay.warmup_steps = min(decay.warmup_steps, steps)


def _decays(schedulers: Mapping[str, LRScheduler]) -> Iterator[tuple[str, LRScheduler, Decay]]:
    """Name, scheduler and multiplier, each once: torch lists one for each group of parameters, which share theirs."""
    for name, scheduler in schedulers.items():
        found = {id(one): one for one in getattr(scheduler, "lr_lambdas", []) if isinstance(one, Decay)}
        yield from ((name, scheduler, decay) for decay in found.values())


def _apply(scheduler: LRScheduler) -> None:
    """Give the optimizer the rate of the next step anew; it has one from before its multiplier changed."""
    multipliers = scheduler.lr_lambdas  # type: ignore[attr-defined]
    rates = [base * at(scheduler.last_epoch) for base, at in zip(scheduler.base_lrs, multipliers, strict=True)]
    for group, rate in zip(scheduler.optimizer.param_groups, rates, strict=True):
        group["lr"] = rate
    scheduler._last_lr = rates
