"""Arms of a comparison: read from files, and checked against the methods of ``ns-train`` before anything is trained."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from harness.plan import WARM_UP, Arm, Kind, Words, words_of
from sundae_ns.core.errors import ConfigError
from sundae_ns.io.pack.container import jsonschema  # without a grammar that takes it a second to compile

DEFAULT_FILE = Path(__file__).with_name("arms.yaml")
"""The default arms; also an example of a file of arms."""

_VALUE = {"anyOf": [{"type": "string"}, {"type": "array", "minItems": 1, "items": {"type": "string"}}]}
_NAME = {"type": "string", "pattern": rf"^[A-Za-z0-9](?!.*{WARM_UP}$)[\w.-]*$"}
_ENTRY = {"name": _NAME, "method": {"type": "string", "minLength": 1}}
_ENTRY["options"] = {"type": "object", "additionalProperties": _VALUE}
_ITEM = {"type": "object", "required": ["name"], "additionalProperties": False, "properties": _ENTRY}
_SCHEMA = {"type": "array", "minItems": 1, "items": _ITEM}
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
        jsonschema.validate(loaded, _SCHEMA)
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read ({' '.join(str(error).split())}); give a file of arms") from error
    except jsonschema.ValidationError as error:
        raise ConfigError(f"{path}, {error.json_path}: {error.message}; {DEFAULT_FILE.name} is an example") from error
    entries = [Entry(item["name"], item.get("method"), _options(item.get("options", {}))) for item in loaded]
    _refuse_duplicates((entry.name for entry in entries), str(path))
    return entries


def _options(given: Mapping[str, str | list[str]]) -> dict[str, Words]:
    """Options by name, without the dashes."""
    options = {}
    for written, value in given.items():
        words = value if isinstance(value, list) else [value]
        options[written.lstrip("-").replace("_", "-")] = tuple(_FLAGS.get(word, word) for word in words)
    if chosen := sorted(options.keys() & set(_SET_BY_BENCH)):
        raise ConfigError(f"an arm sets {chosen[0]}, which the command sets itself; remove it")
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
    from harness.job import parse

    if method not in methods:
        near = difflib.get_close_matches(method, methods) or ["sundae", "splatfacto"]
        raise ConfigError(f"arm {entry.name}: ns-train has no method {method!r}; use {' or '.join(near)}")
    try:
        config: Any = parse((method, *words_of(entry.options)))
        for part in ("pruning", "head"):
            validate = getattr(getattr(config.pipeline.model, part, None), "validate", None)
            if validate is not None:
                validate()
    except SystemExit as error:  # tyro has said why
        raise ConfigError(f"arm {entry.name}: ns-train {method} refuses its options; mend them") from error
    except (ConfigError, ValueError) as error:
        raise ConfigError(f"arm {entry.name}: {error}") from error
    return config
