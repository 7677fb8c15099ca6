"""Optimizers and their schedules, the writer of progress, and the loop of the trainings outside of nerfstudio's."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from nerfstudio.utils.writer import EVENT_STORAGE, GLOBAL_BUFFER, EventName, LocalWriter
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler

from sundae_ns.train.progress import TimeLeft, duration
from sundae_ns.train.schedules import FULL_RATE_INPUTS, NETWORK_BETAS, Decay, DecayShape, fused_adam, network_groups

RATES = {"means": 1.6e-4, "features_dc": 0.0025, "features_rest": 0.0025 / 20, "opacities": 0.05, "scales": 0.005}
RATES |= {"quats": 0.001, "features": 0.0025}  # Learning rates by parameter, splatfacto's
HARMONICS_EVERY = 2  # Steps from one that trains the harmonics to the next; their rate grows as much: 8% less time
METRICS_EVENT = "Train Metrics Dict"  # Event of nerfstudio's trainer with the metrics of a training image
LINE_EVERY = 10.0  # Seconds between two lines


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """nerfstudio's Adam by :func:`sundae_ns.train.schedules.fused_adam`."""

    betas: tuple[float, float] = (0.9, 0.999)  # Decay rates of the running means of gradients and of their squares
    decoupled: bool = False
    """Whether weight decay acts beside Adam's step (Loshchilov & Hutter 2019), not through the gradient."""

    def setup(self, params: Iterable[torch.Tensor]) -> Optimizer:
        """Optimizer of one group of parameters."""
        options = {name: getattr(self, name) for name in ("eps", "betas", "weight_decay")}
        return fused_adam(self._groups(list(params)), decoupled_weight_decay=self.decoupled, **options)

    def _groups(self, params: list[torch.Tensor]) -> list[dict[str, Any]]:
        return [{"params": params, "lr": self.lr}]


@dataclass
class NetworkAdamConfig(FusedAdamConfig):
    """Adam for a network without normalisation layers, see :func:`sundae_ns.train.schedules.network_groups`."""

    betas: tuple[float, float] = NETWORK_BETAS  # Decay rates of the running means of gradients and of their squares
    full_rate_inputs: int = FULL_RATE_INPUTS  # Weights with more inputs than this get a proportionally smaller rate
    decoupled: bool = True

    def _groups(self, params: list[torch.Tensor]) -> list[dict[str, Any]]:
        return network_groups(params, self.lr, self.weight_decay, self.full_rate_inputs)


@dataclass
class PruneAwareDecayConfig(SchedulerConfig):
    """Decay that the prune can restart."""

    _target: type = field(default_factory=lambda: PruneAwareDecay)  # target class to instantiate
    lr_final: float = 1.6e-6  # Learning rate at max_steps
    max_steps: int = 30000  # Step at which the decay ends
    lr_restart: float | None = None
    """Learning rate right after the prune, where the decay restarts; None does not restart it."""
    hold_until_prune: bool = False
    """Whether the rate stays constant until pruning has ended and the head is enabled; the decay starts there."""
    warmup_steps: int = 0  # Steps over which the rate rises after the prune
    shape: DecayShape = "exponential"  # Decay by an exponential, or along half a cosine


class PruneAwareDecay(Scheduler):
    """Builds the torch scheduler of a :class:`PruneAwareDecayConfig`."""

    config: PruneAwareDecayConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LRScheduler:
        """A ``LambdaLR`` whose state holds Python numbers only."""
        config = self.config
        restart = None if config.lr_restart is None else config.lr_restart / lr_init
        shape = config.hold_until_prune, config.warmup_steps, config.shape
        return LambdaLR(optimizer, Decay(config.lr_final / lr_init, config.max_steps, restart, *shape))


def optimise(
    optimizers: Mapping[str, Optimizer], steps: int, factor: Callable[[str, int], float], first: int = 0
) -> Iterator[int]:
    """Steps to take, from ``first`` on, with learning rates by the step, so that a resumed training repeats them.

    ``factor`` is of the initial rate of an optimizer (by name): the present one, unless a group holds ``initial_lr``.
    """
    groups = [(name, group) for name, optimizer in optimizers.items() for group in optimizer.param_groups]
    for _, group in groups:
        group.setdefault("initial_lr", float(group["lr"]))
    for i in range(first, steps):
        for name, group in groups:
            rate = group["initial_lr"] * factor(name, i)
            # In place, where a recorded CUDA graph reads it.
            group["lr"] = group["lr"].fill_(rate) if isinstance(group["lr"], torch.Tensor) else rate
        yield i


def rate_factor(step: int, steps: int) -> float:
    """Share of the peak rate at a step: a short rise, because Adam has no moments yet, then half a cosine to 0."""
    rise = max(round(0.05 * steps), 1)
    if step < rise:
        return (step + 1) / (rise + 1)
    return 0.5 * (1 + math.cos(math.pi * (step - rise) / max(steps - rise, 1)))


class ProgressWriter(LocalWriter):
    """Prints a line every ten seconds. nerfstudio's table moves the cursor, even in a log file, and has no PSNR."""

    def __init__(self, config: Any, banner_messages: list[str] | None = None) -> None:
        super().__init__(config, banner_messages)
        for line in banner_messages or []:
            print(line, flush=True)
        self._printed_at = -LINE_EVERY
        self._metrics: Any = None
        self._time_left = TimeLeft()

    def write_stats_log(self, step: int) -> None:
        """Print a line if it is due; ``step`` belongs to nerfstudio's first event, the configuration after a start."""
        events = {event["name"]: event for event in EVENT_STORAGE}
        # nerfstudio measures every few steps only, and ten steps after a prune may take a minute on a CPU.
        if METRICS_EVENT in events:
            self._metrics = events[METRICS_EVENT]["event"]
        trained = events.get(EventName.ITER_TRAIN_TIME.value)
        if trained is not None and self._metrics is not None and time.monotonic() - self._printed_at >= LINE_EVERY:
            self._printed_at = time.monotonic()
            done, total = trained["step"] + 1, GLOBAL_BUFFER["max_iter"]
            left = self._time_left.update(done, total, self._printed_at)
            speed = 1000 * (self._time_left.step_s or 0.0)
            pace = "" if left is None else f"{duration(left)} left at {speed:.0f} ms a step  "
            figures = f"PSNR {float(self._metrics['psnr']):.2f} dB  {self._metrics['gaussian_count']:,} Gaussians"
            with suppress(BrokenPipeError):  # of a killed `sundae run`, after which this training still saves
                print(f"{done} ({100 * done / max(total, 1):.2f}%)  {pace}{figures}", flush=True)
