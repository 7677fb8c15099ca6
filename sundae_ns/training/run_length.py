"""The schedule of a run: all options that count steps, and how they follow the length of the run.

A method's options are written for the method's own length, 30,000 steps for ``sundae``. :func:`fit_to_length` scales
those that nobody set by hand to another length; nothing else in the package knows a factor.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Iterable
from copy import deepcopy
from pathlib import Path
from typing import Any

from sundae_ns.errors import CheckpointError, ConfigError
from sundae_ns.storage import checkpoint
from sundae_ns.storage.config_file import find_config, load_config
from sundae_ns.storage.pack import FINETUNE_STEPS, tuned_steps
from sundae_ns.training.warning import warn

SCHEDULE = {
    "pipeline.model": "warmup_length stop_split_at stop_screen_size_at resolution_schedule sh_degree_interval "
    "refine_every",
    "pipeline.model.pruning": "prune_at start stop every",
    "pipeline.model.head": "start_at",
}
"""Options of the model that count steps, by the configuration that has them. Learning rates have more."""

LEAST_IMAGES = 50
"""Images that densification sees between two rounds, at least: fewer say too little of a primitive's gradient."""
LEAST_RECOVERY = 1000
"""Least steps between two resets of the opacities: shorter runs have no time to recover, and do without."""
LONGEST_RISE = 12
"""A learning rate rises over at most this fraction of the run."""

_SHAPES = ("sh_degree", "head.size", "head.num_features", "head.pixel_unshuffle")
"""Options of the model that the shapes in a checkpoint depend on."""
RESETS = "pipeline.model.reset_alpha_every"
"""Counts rounds of densification, not steps."""


def set_schedule(config: Any, words: Iterable[str]) -> None:
    """Fit all options that count steps to the length of the run, or take those of the run that is resumed.

    Args:
        config: ``SundaeTrainerConfig``; its schedule changes.
        words: the command line; options in it keep their value.

    Raises:
        ConfigError: the length is no number of steps.
    """
    from nerfstudio.configs.method_configs import all_methods  # imports the entry points, so not at the top

    usual: Any = deepcopy(all_methods.get(str(config.method_name)))
    given, place = given_options(words), config.load_dir or config.load_checkpoint
    if place is not None:
        run = _resumed_run(config, place)
        if run is not None and usual is not None:
            for line in take_options(config, run, usual, given):
                warn(line + ("; a prune that is done is not repeated" if ".pruning." in line else ""))
            config.schedule_length = config.schedule_length or run.schedule_length or run.max_num_iterations
            if "max_num_iterations" not in given and config.max_num_iterations == usual.max_num_iterations:
                config.max_num_iterations = _steps_left(config, place)
        # Without its configuration, nothing says how long the run was meant to be: options stay as they are.
        config.schedule_length = config.schedule_length or config.max_num_iterations
        if run is not None and "max_num_iterations" not in given:
            _leave_finetune(config, config.schedule_length - config.max_num_iterations)
        return
    if config.schedule_length is None:
        config.schedule_length = config.max_num_iterations
    if config.schedule_length < 1:
        raise ConfigError(
            f"the length of the run is {config.schedule_length}; give --max-num-iterations 30000, or fewer"
        )
    _leave_finetune(config, done=0)
    if usual is not None:
        fit_to_length(config, usual, given)


def _leave_finetune(config: Any, done: int) -> None:
    """End the training before the steps that a fine-tune takes the place of, unless all others are done."""
    steps = config.finetune_steps
    if steps is None:
        return
    if steps < 1:
        raise ConfigError(f"finetune-steps is {steps}; give {FINETUNE_STEPS}, or leave it out")
    left = config.schedule_length - tuned_steps(config.schedule_length, steps) - done
    if left > 0:
        config.max_num_iterations = min(config.max_num_iterations, left)


def _steps_left(config: Any, place: Path) -> int:
    """Steps from the checkpoint that is resumed to the end of the schedule."""
    step = checkpoint.newest_step(place) if config.load_step is None else config.load_step
    left: int = config.schedule_length if step is None else config.schedule_length - step - 1
    if left < 1:
        raise ConfigError(
            f"the run has trained all of its {config.schedule_length:,} steps; give the number of further ones with "
            "--max-num-iterations"
        )
    return left


def _resumed_run(config: Any, place: Path) -> Any:
    """The configuration of the run that is resumed; None if it is not beside its checkpoints."""
    path = find_config(place)
    try:
        run = None if path is None else load_config(path)
    except CheckpointError as error:
        warn(f"{error}; the run is resumed with the options of this command")
        return None
    return run if isinstance(run, type(config)) else None


def given_options(words: Iterable[str]) -> frozenset[str]:
    """Dotted names of the options in a command line: ``pipeline.model.sh_degree`` of ``--pipeline.model.sh-degree``."""
    return frozenset(re.split("[= ]", word[2:])[0].replace("-", "_") for word in words if word.startswith("--"))


def step_options(config: Any) -> list[str]:
    """Dotted names of all options of a trainer's configuration that the schedule consists of."""
    names = [f"{owner}.{name}" for owner, text in SCHEDULE.items() for name in text.split()]
    for group, parts in config.optimizers.items():
        if parts["scheduler"] is not None:
            names += [f"optimizers.{group}.scheduler.{name}" for name in ("max_steps", "warmup_steps")]
    return [*names, RESETS]


def fit_to_length(config: Any, usual: Any, given: Collection[str]) -> None:
    """Scale the schedule to ``config.schedule_length``, but for options that were set by hand.

    A warm start skips the steps before the prune. Its schedule is compressed only if the steps after it do not fit.

    Args:
        config: ``SundaeTrainerConfig``; its schedule changes.
        usual: the method's own configuration.
        given: dotted names of options that keep their value, beside those that differ from ``usual``.
    """
    share = config.schedule_length / usual.max_num_iterations
    if share == 1:
        return
    model, usual_model = config.pipeline.model, usual.pipeline.model
    steps_share = share
    if model.warm_start is not None:
        left = usual.max_num_iterations - usual_model.pruning.prune_at
        steps_share = min(config.schedule_length / max(left, 1), 1.0)
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
    """Give a configuration schedule and model of the run that it resumes, but for options that were set by hand.

    Args:
        config: ``SundaeTrainerConfig``; its schedule and its model change.
        run: the configuration of that run.
        usual: the method's own configuration.
        given: see :func:`fit_to_length`.

    Returns:
        A line for each option that the run has otherwise.

    Raises:
        ConfigError: an option would change shapes or schedulers of the checkpoint.
    """
    config.optimizers = deepcopy(config.optimizers)
    names = [*step_options(usual), *_leaves(usual.pipeline.model, "pipeline.model")]
    free = set(_free(config, usual, given, names))
    differing = []
    for name in dict.fromkeys(names):
        theirs = option(run, name)
        if name in free:
            set_option(config, name, deepcopy(theirs))
        elif option(config, name) != theirs:
            line = f"--{name.replace('_', '-')} is {option(config, name)}; the run to resume has {theirs}"
            # The state of a scheduler holds its options. Refused before config.yml is replaced.
            if name.removeprefix("pipeline.model.") in _SHAPES or name.startswith("optimizers."):
                raise ConfigError(f"{line}, which cannot change; leave the option out")
            differing.append(line)
    return differing


def schedule_table(config: Any) -> list[tuple[str, str]]:
    """What happens when, for the log: pairs of a part of training and its steps."""
    model = config.pipeline.model
    warm, head = model.warm_start is not None, model.head
    schedulers = (parts["scheduler"] for parts in config.optimizers.values())
    ends = sorted({scheduler.max_steps for scheduler in schedulers if scheduler is not None})
    rows = [
        ("images", "full size" if warm else _resolution(model)),
        ("densification", "none: warm start" if warm else _growth(model)),
        ("SH degree", f"{model.sh_degree}" if warm else f"+1 every {model.sh_degree_interval:,} steps"),
        ("prune", _prune(model.pruning, warm)),
        ("head", "none" if head.mode == "off" else _head(model, warm)),
    ]
    if ends:
        rows.append(("learning rates", f"decay until {', '.join(f'{end:,}' for end in ends)}"))
    return rows


def _resolution(model: Any) -> str:
    parts = [
        f"1/{2 ** (model.num_downscales - number)} until {(number + 1) * model.resolution_schedule:,}"
        for number in range(model.num_downscales)
    ]
    return ", ".join([*parts, "then full size"]) if parts else "full size"


def _growth(model: Any) -> str:
    ends = model.pruning.stop if model.pruning.mode == "continuous" else model.pruning.ends_growth_at
    last = model.stop_split_at if ends is None else min(model.stop_split_at, ends)
    text = f"{model.warmup_length:,} to {last:,}, every {model.refine_every:,}"
    resets = model.reset_alpha_every * model.refine_every
    return text + (f"; opacities reset every {resets:,}" if resets < last else "; opacities never reset")


def _prune(pruning: Any, warm: bool) -> str:
    if pruning.mode == "continuous":
        return f"{pruning.start:,} to {pruning.stop:,}, every {pruning.every:,}"
    if pruning.mode == "off":
        return "none"
    after = "at once" if warm else f"after {pruning.prune_at:,}"
    return f"{after}, to as many as trials choose" if pruning.decides and not warm else after


def _head(model: Any, warm: bool) -> str:
    at = model.pruning.settled_at if model.head.start_at is None else model.head.start_at
    at = max(at - (model.pruning.prune_at if warm else 0), 0)
    when = f"after {at:,}" if at else "from the start"
    return f"{when}, if trials favour it" if model.head.mode == "auto" else when


def _free(config: Any, usual: Any, given: Collection[str], names: Iterable[str]) -> list[str]:
    """The options among ``names`` that nobody set by hand."""
    return [name for name in names if name not in given and option(config, name) == option(usual, name)]


def _leaves(config: Any, prefix: str) -> list[str]:
    """Dotted names of all options in a configuration and in those that it holds."""
    names = []
    for field in dataclasses.fields(config):
        name, value = f"{prefix}.{field.name}", getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            names += _leaves(value, name)
        elif field.name != "_target":
            names.append(name)
    return names


def option(config: Any, name: str) -> Any:
    """Value of the option of a dotted name; None if there is none."""
    for part in name.split("."):
        config = config.get(part) if isinstance(config, dict) else getattr(config, part, None)
    return config


def set_option(config: Any, name: str, value: Any) -> None:
    """Set the option of a dotted name."""
    owner, _, last = name.rpartition(".")
    setattr(option(config, owner) if owner else config, last, value)
