"""What changes with the step: learning rates, and all options that count steps, fitted to the length of the run.

A method's options are written for the method's own length, 30,000 steps for ``sundae``. :func:`fit_to_length` scales
those that nobody set by hand to another length; nothing else in the package knows a factor.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from torch.optim.lr_scheduler import LRScheduler

from sundae_ns.core.errors import CheckpointError, ConfigError
from sundae_ns.io import checkpoint
from sundae_ns.io.config_file import find_config, load_config
from sundae_ns.io.pack.config import FINETUNE_STEPS, tuned_steps

_log = logging.getLogger(__name__)

DecayShape = Literal["exponential", "cosine"]

SPARSE = 15_000  # With fewer Gaussians after the prune centres move faster: on surfaces they are farther apart
MOST_FACTOR = 5.0  # Largest factor on the learning rate of the centres: fewer than 600 Gaussians were not measured
NETWORK_BETAS = (0.9, 0.95)
FULL_RATE_INPUTS = 1152  # 3 x 3 of 128 channels, the most in the default head


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
    after_prune: float = 1.0  # Factor on the rate after the prune
    ends_at: int | None = None  # Step at which the decay after the prune ends, in place of max_steps

    def __call__(self, step: int) -> float:
        """The multiplier at ``step``."""
        if self.pruned_at is None and self.hold_until_prune:
            return 1.0
        start, begin, end, rise, factor = 1.0, 0, self.max_steps, 1.0, 1.0
        if self.pruned_at is not None and self.restart is not None and step >= self.pruned_at:
            start, begin, factor = self.restart, self.pruned_at, self.after_prune
            end = self.max_steps if self.ends_at is None else self.ends_at
            rise = min((step - begin + 1) / (self.warmup_steps + 1), 1.0)
        t = min(max((step - begin) / max(end - begin, 1), 0.0), 1.0)
        if self.shape == "cosine":
            return float(rise * factor * (self.final + (start - self.final) * (1.0 + math.cos(math.pi * t)) / 2.0))
        return float(rise * factor * start ** (1.0 - t) * self.final**t)


def fused_adam(groups: list[dict[str, Any]], **options: Any) -> torch.optim.Adam:
    """Adam that updates each parameter by one fused kernel on CUDA instead of a dozen."""
    fused = all(value.is_cuda for group in groups for value in group["params"])
    return torch.optim.Adam(groups, fused=fused, **options)


def network_groups(
    params: Iterable[Tensor], lr: float, weight_decay: float, full_rate_inputs: int = FULL_RATE_INPUTS
) -> list[dict[str, Any]]:
    """Groups of parameters of a network without normalisation layers, whose loss bursts at usual settings of Adam.

    With :data:`NETWORK_BETAS` the mean of squares follows gradients that suddenly grow: a weight moves by up to 1.2
    times the learning rate while they grow, and by 7.3 with the usual betas
    (``(1 - b1) / sqrt((1 - b2) (1 - b1^2 / b2))``). Weights of layers with more than ``full_rate_inputs`` inputs get a
    proportionally smaller rate, because their sum grows with the inputs (Yang et al. 2022, "Tensor Programs V"). Only
    weights decay. A head that is resized in training keeps the rates of its first shapes.
    """
    groups: dict[tuple[float, float], list[Tensor]] = {}
    for value in params:
        inputs = value[0].numel() if value.ndim > 1 else 1
        rate = lr * min(full_rate_inputs / inputs, 1.0)
        groups.setdefault((rate, weight_decay if value.ndim > 1 else 0), []).append(value)
    return [{"params": values, "lr": rate, "weight_decay": decay} for (rate, decay), values in groups.items()]


def sparse_factor(count: int) -> float:
    """Factor on the learning rate of the centres after a prune to this number of Gaussians."""
    return min(max(1.0, math.sqrt(SPARSE / max(count, 1))), MOST_FACTOR)


def notify_pruned(
    schedulers: Mapping[str, LRScheduler], step: int, count: int, *, last: bool = True, ends_at: int | None = None
) -> None:
    """Restart every :class:`Decay` among ``schedulers`` at the ``step`` of a prune; later calls change nothing.

    ``count`` Gaussians were kept; of fewer than :data:`SPARSE` the centres move faster. ``last`` is False while pruning
    continues or the head is still disabled: rates that hold until then are left alone. They reach their final value at
    the step ``ends_at``, as for a trial; None stands for that of the run.
    """
    for name, scheduler, decay in _decays(schedulers):
        if decay.pruned_at is None and (last or not decay.hold_until_prune):
            decay.pruned_at, decay.ends_at = step, ends_at
            if name == "means":
                decay.after_prune = sparse_factor(count)
            _apply(scheduler)


def restarts(schedulers: Mapping[str, LRScheduler]) -> dict[str, tuple[int | None, float, int | None]]:
    """By name the step at which a :class:`Decay` has restarted, its factor since, and the step at which it ends."""
    return {name: (decay.pruned_at, decay.after_prune, decay.ends_at) for name, _, decay in _decays(schedulers)}


def put_restarts(schedulers: Mapping[str, LRScheduler], saved: Mapping[str, Any], later: int) -> None:
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
        decays = {id(decay): decay for decay in getattr(scheduler, "lr_lambdas", []) if isinstance(decay, Decay)}
        yield from ((name, scheduler, decay) for decay in decays.values())


def _apply(scheduler: LRScheduler) -> None:
    """Give the optimizer the rate of the next step anew; it has one from before its multiplier changed."""
    multipliers = scheduler.lr_lambdas  # type: ignore[attr-defined]
    rates = [base * at(scheduler.last_epoch) for base, at in zip(scheduler.base_lrs, multipliers, strict=True)]
    for group, rate in zip(scheduler.optimizer.param_groups, rates, strict=True):
        group["lr"] = rate
    scheduler._last_lr = rates


SCHEDULE = (
    "warmup_length stop_split_at stop_screen_size_at resolution_schedule sh_degree_interval refine_every "
    "pruning.prune_at pruning.start pruning.stop pruning.every head.start_at"
).split()
"""Options of the model that count steps. Learning rates have more."""

LEAST_IMAGES = 50  # Images between two rounds of densification: fewer say too little of a Gaussian's gradient
LEAST_RECOVERY = 1000  # Least steps between two resets of the opacities: shorter runs have no time to recover
LONGEST_RISE = 12  # A learning rate rises over at most the length of the run divided by this
_SHAPES = ("sh_degree", "head.size", "head.num_features", "head.pixel_unshuffle")  # Shapes in a checkpoint follow them
RESETS = "pipeline.model.reset_alpha_every"  # Counts rounds of densification, not steps


def set_schedule(config: Any, usual: Any, words: Iterable[str]) -> None:
    """Fit all options that count steps to the length of the run, or take those of the run that is resumed.

    The schedule of ``config``, a ``SundaeTrainerConfig``, changes; ``usual`` is the method's own configuration, None if
    it is not known. Options in the command line ``words`` keep their value. ``ConfigError`` if no steps are left, or
    the length is no number of steps.
    """
    usual = deepcopy(usual)  # config may share parts with it
    given = given_options(words)
    if (saved := config.load_dir or config.load_checkpoint) is not None:
        if (run := _resumed_run(config, saved)) is not None and usual is not None:
            for line in take_options(config, run, usual, given):
                _log.warning(line + ("; a prune that is done is not repeated" if ".pruning." in line else ""))
            config.schedule_length = config.schedule_length or run.schedule_length or run.max_num_iterations
            if "max_num_iterations" not in given and config.max_num_iterations == usual.max_num_iterations:
                step = checkpoint.newest_step(saved) if config.load_step is None else config.load_step
                left = config.schedule_length - (0 if step is None else step + 1)
                if left < 1:
                    done = f"the run has trained all of its {config.schedule_length:,} steps"
                    raise ConfigError(f"{done}; give the number of further ones with --max-num-iterations")
                config.max_num_iterations = left
        # Without its configuration, nothing says how long the run was meant to be: options stay as they are.
        config.schedule_length = config.schedule_length or config.max_num_iterations
        if run is not None and "max_num_iterations" not in given:
            _leave_finetune(config, config.schedule_length - config.max_num_iterations)
        return
    length = config.max_num_iterations if config.schedule_length is None else config.schedule_length
    if length < 1:
        raise ConfigError(f"the length of the run is {length}; give --max-num-iterations 30000, or fewer")
    config.schedule_length = length
    _leave_finetune(config, done=0)
    if usual is not None:
        fit_to_length(config, usual, given)


def _leave_finetune(config: Any, done: int) -> None:
    """End the training before the steps that a fine-tune takes the place of, unless all others are done."""
    steps, length = config.finetune_steps, config.schedule_length
    if steps is not None and steps < 1:
        raise ConfigError(f"finetune-steps is {steps}; give {FINETUNE_STEPS}, or leave it out")
    if steps is not None and (left := length - tuned_steps(length, steps) - done) > 0:
        config.max_num_iterations = min(config.max_num_iterations, left)


def _resumed_run(config: Any, saved: Path) -> Any:
    """The configuration of the run that is resumed; None if it is not beside its checkpoints."""
    path = find_config(saved)
    try:
        run = None if path is None else load_config(path)
    except CheckpointError as error:
        _log.warning(f"{error}; the run is resumed with the options of this command")
        return None
    return run if isinstance(run, type(config)) else None


def given_options(words: Iterable[str]) -> frozenset[str]:
    """Dotted names of the options in a command line: ``pipeline.model.sh_degree`` of ``--pipeline.model.sh-degree``."""
    return frozenset(re.split("[= ]", word[2:])[0].replace("-", "_") for word in words if word.startswith("--"))


def step_options(config: Any) -> list[str]:
    """Dotted names of all options of a trainer's configuration that the schedule consists of."""
    names = [f"pipeline.model.{name}" for name in SCHEDULE]
    for group, parts in config.optimizers.items():
        if parts["scheduler"] is not None:
            names += [f"optimizers.{group}.scheduler.{name}" for name in ("max_steps", "warmup_steps")]
    return [*names, RESETS]


def fit_to_length(config: Any, usual: Any, given: Collection[str]) -> None:
    """Scale the schedule of a ``SundaeTrainerConfig`` to its ``schedule_length``, but for options set by hand.

    These are the dotted names ``given``, and what differs from ``usual``, the method's own configuration. A warm start
    skips the steps before the prune. Its schedule is compressed only if the steps after it do not fit.
    """
    share = steps_share = config.schedule_length / usual.max_num_iterations
    if share == 1:
        return
    model, usual_model = config.pipeline.model, usual.pipeline.model
    if model.warm_start is not None:
        steps_share = min(config.schedule_length / max(usual.max_num_iterations - usual_model.pruning.prune_at, 1), 1.0)
    config.optimizers = deepcopy(config.optimizers)  # methods share them with every configuration that tyro makes
    free = _free(config, usual, given, step_options(usual))
    for name in free:
        value = option(usual, name)
        if name == RESETS or not value:
            continue
        if name.endswith(".warmup_steps"):
            scaled = min(value, config.schedule_length // LONGEST_RISE)
        else:
            scaled = max(round(value * (share if name.startswith("optimizers.") else steps_share)), 1)
        if name == "pipeline.model.refine_every":
            scaled = max(scaled, min(value, LEAST_IMAGES))
        set_option(config, name, scaled)
    if RESETS in free:
        period = round(usual_model.reset_alpha_every * usual_model.refine_every * steps_share)
        never = model.stop_split_at // model.refine_every + 1
        model.reset_alpha_every = max(round(period / model.refine_every), 1) if period >= LEAST_RECOVERY else never


def take_options(config: Any, run: Any, usual: Any, given: Collection[str]) -> list[str]:
    """Give a ``SundaeTrainerConfig`` the schedule and the model of the ``run`` that it resumes.

    Options that were set by hand stay, see :func:`fit_to_length`. Returns a line for each option that the run has
    otherwise; ``ConfigError`` if one would change shapes or schedulers of the checkpoint.
    """
    config.optimizers = deepcopy(config.optimizers)
    differing: list[str] = []
    names = [*step_options(usual), *_leaves(usual.pipeline.model, "pipeline.model")]
    free = set(_free(config, usual, given, names))
    for name in dict.fromkeys(names):
        value = option(run, name)
        if name in free:
            set_option(config, name, deepcopy(value))
        elif option(config, name) != value:
            line = f"--{name.replace('_', '-')} is {option(config, name)}; the run to resume has {value}"
            # The state of a scheduler holds its options. Refused before config.yml is replaced.
            if name.removeprefix("pipeline.model.") in _SHAPES or name.startswith("optimizers."):
                raise ConfigError(f"{line}, which cannot change; leave the option out")
            differing.append(line)
    return differing


def schedule_table(config: Any) -> list[tuple[str, str]]:
    """What happens when, for the log: pairs of a part of training and its steps."""
    model = config.pipeline.model
    head, pruning = model.head, model.pruning
    warm = model.warm_start is not None
    sizes = [
        f"1/{2 ** (model.num_downscales - i)} until {(i + 1) * model.resolution_schedule:,}, "
        for i in range(0 if warm else model.num_downscales)
    ]
    last, resets = pruning.growth_ends_at(model.stop_split_at), model.reset_alpha_every * model.refine_every
    reset = f"reset every {resets:,}" if resets < last else "never reset"
    growth = f"{model.warmup_length:,} to {last:,}, every {model.refine_every:,}; opacities {reset}"
    prune = {
        "continuous": f"{pruning.start:,} to {pruning.stop:,}, every {pruning.every:,}",
        "off": "none",
        "one-shot": "at once" if warm else f"after {pruning.prune_at:,}",
    }[pruning.mode]
    at = pruning.settled_at if head.start_at is None else head.start_at
    at = max(at - (pruning.prune_at if warm else 0), 0)
    start = (f"after {at:,}" if at else "from the start") + (", if trials favour it" if head.mode == "auto" else "")
    rates = {parts["scheduler"].max_steps for parts in config.optimizers.values() if parts["scheduler"] is not None}
    rows = [
        ("images", "".join([*sizes, "then full size"]) if sizes else "full size"),
        ("densification", "none: warm start" if warm else growth),
        ("SH degree", f"{model.sh_degree}" if warm else f"+1 every {model.sh_degree_interval:,} steps"),
        ("prune", prune + (", to as many as trials choose" if pruning.decides and not warm else "")),
        ("head", "none" if head.mode == "off" else start),
    ]
    if rates:
        rows.append(("learning rates", f"decay until {', '.join(f'{end:,}' for end in sorted(rates))}"))
    return rows


def _free(config: Any, usual: Any, given: Collection[str], names: Iterable[str]) -> list[str]:
    """The options among ``names`` that nobody set by hand."""
    return [name for name in names if name not in given and option(config, name) == option(usual, name)]


def _leaves(config: Any, prefix: str) -> list[str]:
    """Dotted names of all options in a configuration and in those that it holds."""
    if not is_dataclass(config):
        return [prefix]
    names = [entry.name for entry in fields(config) if entry.name != "_target"]
    return [leaf for name in names for leaf in _leaves(getattr(config, name), f"{prefix}.{name}")]


def option(config: Any, name: str) -> Any:
    """Value of the option of a dotted name; None if there is none."""
    for key in name.split("."):
        config = config.get(key) if isinstance(config, dict) else getattr(config, key, None)
    return config


def set_option(config: Any, name: str, value: Any) -> None:
    """Set the option of a dotted name."""
    owner, _, last = name.rpartition(".")
    setattr(option(config, owner) if owner else config, last, value)
