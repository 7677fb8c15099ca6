"""The schedule of a run: all options that count steps, and how they follow the length of the run.

A method's options are written for the method's own length, 30,000 steps for ``sundae``. :func:`fit_to_length` scales those
that nobody set by hand to another length; nothing else in the package knows a factor.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Iterable, Sequence
from copy import deepcopy
from typing import Any

from sundae_ns.errors import ConfigError

SCHEDULE = {
    "pipeline.model": "warmup_length stop_split_at stop_screen_size_at resolution_schedule sh_degree_interval refine_every",
    "pipeline.model.pruning": "prune_at start stop every search_every",
    "pipeline.model.head": "start_at",
}
"""Options of the model that count steps, by the configuration that has them. Learning rates have more."""

LEAST_IMAGES = 50
"""Images that densification sees between two rounds, at least: fewer say too little of a primitive's gradient."""
LEAST_RECOVERY = 1000
"""Steps between two resets of the opacities, at least: shorter runs do without, because they have no time to recover."""
LONGEST_RISE = 12
"""A learning rate rises over at most this fraction of the run."""

_SHAPES = ("sh_degree", "head.size", "head.num_features", "head.pixel_unshuffle")
"""Options of the model that the shapes in a checkpoint depend on."""
_RESETS = "pipeline.model.reset_alpha_every"
_REFINE = "pipeline.model.refine_every"


def given_options(words: Iterable[str]) -> frozenset[str]:
    """Dotted names of the options in a command line: ``pipeline.model.sh_degree`` of ``--pipeline.model.sh-degree 2``."""
    return frozenset(re.split("[= ]", word[2:])[0].replace("-", "_") for word in words if word.startswith("--"))


def step_options(config: Any) -> list[str]:
    """Dotted names of all options of a trainer's configuration that the schedule consists of."""
    names = [f"{owner}.{name}" for owner, text in SCHEDULE.items() for name in text.split()]
    for group, parts in config.optimizers.items():
        if parts["scheduler"] is not None:
            names += [f"optimizers.{group}.scheduler.{name}" for name in ("max_steps", "warmup_steps")]
    return [*names, _RESETS]


def fit_to_length(config: Any, usual: Any, given: Collection[str]) -> None:
    """Scale the schedule to ``config.schedule_length``, but for options that were set by hand.

    A warm start skips the steps before the prune. Its schedule is only compressed, and only if the rest would not fit.

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
    for name in _free(config, usual, given):
        value = _get(usual, name)
        if name == _RESETS or not value:
            continue
        if name.endswith(".warmup_steps"):
            scaled = min(value, config.schedule_length // LONGEST_RISE)
        else:
            scaled = max(round(value * (share if name.startswith("optimizers.") else steps_share)), 1)
        if name == _REFINE and model.warmup == "densify":
            scaled = max(scaled, min(value, LEAST_IMAGES))
        _set(config, name, scaled)
    if _RESETS in _free(config, usual, given):
        period = round(usual_model.reset_alpha_every * usual_model.refine_every * steps_share)
        never = model.stop_split_at // model.refine_every + 1
        model.reset_alpha_every = max(round(period / model.refine_every), 1) if period >= LEAST_RECOVERY else never


def take_options(config: Any, run: Any, usual: Any, given: Collection[str]) -> list[str]:
    """Give a configuration the schedule and the model of the run that it resumes, but for options that were set by hand.

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
        theirs = _get(run, name)
        if name in free:
            _set(config, name, deepcopy(theirs))
        elif _get(config, name) != theirs:
            line = f"--{name.replace('_', '-')} is {_get(config, name)}; the run to resume has {theirs}"
            # The state of a scheduler holds its options. Refused before config.yml is replaced.
            if name.removeprefix("pipeline.model.") in _SHAPES or name.startswith("optimizers."):
                raise ConfigError(f"{line}, which cannot change; leave the option out")
            differing.append(line)
    return differing


def schedule_table(config: Any) -> list[tuple[str, str]]:
    """What happens when, for the log: pairs of a part of training and its steps."""
    model = config.pipeline.model
    pruning, warm = model.pruning, model.warm_start is not None
    rows = [
        ("images", "full size" if warm else _resolution(model)),
        ("densification", "none: warm start" if warm else _growth(model)),
        ("SH degree", f"{model.sh_degree}" if warm else f"+1 every {model.sh_degree_interval:,} steps"),
        ("prune", _prune(pruning, warm)),
        ("head", _head(model, warm)),
        ("learning rates", _rates(config)),
    ]
    return [(name, text) for name, text in rows if text]


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
    if model.warmup == "mcmc":
        return f"{text} (MCMC)"
    resets = model.reset_alpha_every * model.refine_every
    return text + (f"; opacities reset every {resets:,}" if resets < last else "; opacities never reset")


def _prune(pruning: Any, warm: bool) -> str:
    if pruning.mode == "continuous":
        return f"{pruning.start:,} to {pruning.stop:,}, every {pruning.every:,}"
    if pruning.mode == "off":
        return "none"
    after = "at once" if warm else f"after {pruning.prune_at:,}"
    if pruning.mode == "one-shot":
        return after
    last = pruning.stop - (pruning.prune_at if warm else 0)
    return f"search {after}, until {last:,}, an evaluation every {pruning.search_every:,}"


def _head(model: Any, warm: bool) -> str:
    if model.head.mode == "off":
        return "none"
    if model.pruning.mode == "auto":
        return "when the search enables it"
    at = model.pruning.settled_at if model.head.start_at is None else model.head.start_at
    at = max(at - (model.pruning.prune_at if warm else 0), 0)
    when = f"after {at:,}" if at else "from the start"
    return f"{when}, if trials favour it" if model.head.mode == "auto" else when


def _rates(config: Any) -> str:
    ends = {parts["scheduler"].max_steps for parts in config.optimizers.values() if parts["scheduler"] is not None}
    return f"decay until {', '.join(f'{end:,}' for end in sorted(ends))}" if ends else ""


def _free(config: Any, usual: Any, given: Collection[str], names: Sequence[str] | None = None) -> Sequence[str]:
    """Those of ``names``, by default the step options, that nobody set by hand."""
    names = step_options(usual) if names is None else names
    return [name for name in names if name not in given and _get(config, name) == _get(usual, name)]


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


def _get(config: Any, name: str) -> Any:
    for part in name.split("."):
        config = config.get(part) if isinstance(config, dict) else getattr(config, part, None)
    return config


def _set(config: Any, name: str, value: Any) -> None:
    owner, _, last = name.rpartition(".")
    setattr(_get(config, owner), last, value)
