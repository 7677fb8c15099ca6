"""Arms of a comparison: read from files, and checked against the methods of ``ns-train`` before anything is trained."""

from __future__ import annotations

import contextlib
import difflib
import io
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import tyro
import yaml

from harness.plan import WARM_UP, Arm, Kind, Words
from sundae_ns.core.errors import ConfigError

DEFAULT_FILE = Path(__file__).with_name("arms.yaml")
"""The default arms; also an example of a file of arms."""

_NAME = re.compile(r"[A-Za-z0-9][\w.-]*")
_KEEP_RATIO, _STEPS = "pipeline.model.pruning.keep-ratio", "max-num-iterations"
_SET_BY_BENCH = ("data", "machine.seed", "output-dir", "experiment-name", "timestamp", "pipeline.model.warm-start")
_FLAGS = {"true": "True", "false": "False", "null": "None"}
"""Values that YAML and ``ns-train`` write differently."""


@dataclass(frozen=True)
class Entry:
    """An arm as a file describes it."""

    name: str
    method: str | None
    """None: the method of the command."""
    options: Mapping[str, Words]


def choose_arms(words: Sequence[str], method: str, scale: float = 1.0, *, from_scratch: bool = False) -> list[Arm]:
    """The arms that a command names, with their lengths; ``ConfigError`` if one cannot work."""
    if not scale > 0:
        raise ConfigError(f"steps-scale is {scale}; give a positive factor, 0.01 for a trial")
    defaults = {entry.name: entry for entry in read_entries(DEFAULT_FILE)}
    entries: list[Entry] = []
    for word in words or defaults:
        if word in defaults:
            entries.append(defaults[word])
        elif Path(word).suffix in (".yaml", ".yml"):
            entries += read_entries(Path(word))
        else:
            raise ConfigError(f"{word} is no arm; use some of {', '.join(defaults)}, or a file of arms (.yaml)")
    _refuse_duplicates((entry.name for entry in entries), "--arms")
    return [_checked(entry, method, scale, from_scratch) for entry in entries]


def read_entries(path: Path) -> list[Entry]:
    """The arms of a file; ``ConfigError`` if it cannot be read, or is no list of arms."""
    try:
        # Scalars stay text: YAML would read `off` as False.
        loaded = yaml.load(path.read_text(encoding="utf-8"), Loader=yaml.BaseLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); give a file of arms") from error
    except (yaml.YAMLError, RecursionError) as error:
        raise ConfigError(f"{path} is no YAML ({' '.join(str(error).split())}); mend it") from error
    if not isinstance(loaded, list) or not loaded:
        raise ConfigError(f"{path} holds no list of arms; write `- name: NAME` for each, its method and options below")
    entries = [_entry(item, f"{path}, arm {number}") for number, item in enumerate(loaded, start=1)]
    _refuse_duplicates((entry.name for entry in entries), str(path))
    return entries


def _entry(item: Any, where: str) -> Entry:
    """One item of a file's list."""
    if not isinstance(item, dict) or not isinstance(item.get("name"), str):
        raise ConfigError(f"{where} has no name; write `- name: NAME`")
    name, method = item["name"], item.get("method")
    unknown = sorted(set(map(str, item)) - {"name", "method", "options"})
    if unknown:
        raise ConfigError(f"{where} ({name}) has {unknown[0]!r}; an arm has name, method and options")
    if not _NAME.fullmatch(name) or name.endswith(WARM_UP):
        raise ConfigError(f"{where} cannot be named {name!r}; use letters, digits, '.', '_' and '-', not ...{WARM_UP}")
    if not isinstance(method, str | None) or method == "":
        raise ConfigError(f"{where} ({name}) has a method that is no name; write `method: sundae`, or leave it out")
    return Entry(name, method, _read_options(item.get("options", {}), f"{where} ({name})"))


def _read_options(given: Any, where: str) -> dict[str, Words]:
    """Options by name, without the dashes."""
    if not isinstance(given, dict):
        raise ConfigError(f"{where} has options that are no mapping; write `name: value`")
    options: dict[str, Words] = {}
    for written, value in given.items():
        name = written.lstrip("-").replace("_", "-")
        words = tuple(value) if isinstance(value, list) else (value,)
        if not words or not all(isinstance(word, str) for word in words):
            raise ConfigError(f"{where} has option {name} without a plain value; write `{name}: value`")
        if name in _SET_BY_BENCH:
            raise ConfigError(f"{where} sets {name}, which the command sets itself; remove it")
        options[name] = tuple(_FLAGS.get(word, word) for word in words)
    return options


def _refuse_duplicates(names: Iterable[str], where: str) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise ConfigError(f"{where} has {name} twice; give each once")


def _checked(entry: Entry, default: str, scale: float, from_scratch: bool) -> Arm:
    from nerfstudio.configs.method_configs import all_methods
    from nerfstudio.models.splatfacto import SplatfactoModelConfig

    from sundae_ns.plugin.model import SundaeModelConfig

    method = entry.method or default
    config, whole = _config_of(entry, method, all_methods), dict[str, Any](all_methods)[method]
    model = whole.pipeline.model
    if not isinstance(model, SplatfactoModelConfig):
        raise ConfigError(f"arm {entry.name}: {method} has no Gaussians; use splatfacto or a method of this package")
    mode = model.pruning.mode if isinstance(model, SundaeModelConfig) else None
    if method == default and mode != "one-shot":
        raise ConfigError(f"{method!r} is no method of ours that prunes once; use sundae, or sundae-tiny for a trial")
    kind: Kind = "whole"
    # To a share of the plan; an arm of a named method that decides about the number trains whole, at its own.
    pruning = None if mode is None else config.pipeline.model.pruning
    decides = pruning is not None and pruning.decides and entry.method is not None
    prunes_once = pruning is not None and pruning.mode == "one-shot" and not decides
    if prunes_once and (entry.options or not from_scratch):
        kind = "branch"
    options, ratio = dict(entry.options), None
    own_steps = _scaled(config.max_num_iterations, scale)
    warmup, total, steps = 0, 0, own_steps
    if kind != "whole":
        prune_at = whole.pipeline.model.pruning.prune_at
        warmup, steps = _scaled(prune_at, scale), _scaled(whole.max_num_iterations - prune_at, scale)
        total = warmup + steps
        if options.pop(_KEEP_RATIO, None) is not None:
            ratio = config.pipeline.model.pruning.keep_ratio
    elif mode is not None:
        # Evaluating around a prune would count as training.
        options = {"pipeline.model.evaluate-prune": ("False",), **options}
    if options.pop(_STEPS, None) is not None:
        steps = own_steps
    return Arm(entry.name, kind, method, options, steps, warmup, total, ratio, kind == "whole" and prunes_once)


def _scaled(steps: int, scale: float) -> int:
    """A length times a factor, at least 1."""
    return max(round(steps * scale), 1)


def _config_of(entry: Entry, method: str, methods: Mapping[str, Any]) -> Any:
    if method not in methods:
        near = difflib.get_close_matches(method, methods) or ["sundae", "splatfacto"]
        raise ConfigError(f"arm {entry.name}: ns-train has no method {method!r}; use {' or '.join(near)}")
    words = [word for name, value in entry.options.items() for word in (f"--{name}", *value)]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            config = _parse(method, tuple(words))
        for part in ("pruning", "head"):
            validate = getattr(getattr(config.pipeline.model, part, None), "validate", None)
            if validate is not None:
                validate()
    except SystemExit as error:
        meant = re.search(r"Perhaps you meant:\s+--(\S+)", said.getvalue())
        sanitise = f"did you mean {meant[1]}?" if meant else f"`ns-train {method} --help` lists its options"
        raise ConfigError(f"arm {entry.name}: {_message_of(said.getvalue())}; {sanitise}") from error
    except (ConfigError, ValueError) as error:
        raise ConfigError(f"arm {entry.name}: {error}") from error
    return config


@cache  # a parse takes a third of a second
def _parse(method: str, words: Words) -> Any:
    """A configuration with options of the command line, as ``ns-train`` parses them; not to be changed."""
    from nerfstudio.configs.method_configs import all_methods

    default = all_methods[method]
    return tyro.cli(tyro.conf.FlagConversionOff[type(default)], default=default, args=words)  # type: ignore[misc]


def _message_of(box: str) -> str:
    """The message in tyro's box of an error, in one line: between the title and the rule below it."""
    lines = [line.strip("╭╮╰╯│ ") for line in box.splitlines()]
    is_rule = [set(line) <= {"─", "-"} for line in lines]
    words: list[str] = []
    for line, rule in zip(lines[1:], is_rule[1:], strict=True):
        if rule and words:
            break
        words += [] if rule else line.split()
    return " ".join(words).rstrip(".") or "ns-train refuses its options"
