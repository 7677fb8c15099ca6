"""A run's ``config.yml`` as objects of nerfstudio, without running it. nerfstudio's own reader calls what it names."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from enum import Enum
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import FunctionType
from typing import Any

import yaml
from yaml.constructor import ConstructorError

from sundae_ns.core.errors import CheckpointError, reading, regular
from sundae_ns.io.formats import PRIMITIVES, kind_of, unread

_GROUPS = ("nerfstudio.method_configs", "nerfstudio.dataparser_configs")


class _ConfigLoader(yaml.SafeLoader):
    """Makes configurations only; calls no constructor and no function that a file names."""


@cache
def _trusted_packages() -> frozenset[str]:
    """Packages whose classes a configuration may name; nerfstudio imports plug-ins, its variables' too, anyway."""
    named = [point.value for group in _GROUPS for point in entry_points(group=group)]
    for group in _GROUPS:
        named += re.findall("=([^,]+)", os.environ.get(group.upper().replace(".", "_"), ""))
    return frozenset({"nerfstudio", "sundae_ns", "gsplat", "torch"} | {re.split("[.:]", name)[0] for name in named})


def _refused(node: yaml.Node, reason: str) -> ConstructorError:
    """The error for what a configuration may not hold, and its place in the file."""
    return ConstructorError(None, None, reason, node.start_mark)


def _named(name: str, node: yaml.Node) -> Any:
    """The class or function of a dotted name, which a trusted package must define."""
    module, _, attribute = name.rpartition(".")
    value = None
    if module.partition(".")[0] in _trusted_packages():
        with suppress(ImportError):
            value = getattr(importlib.import_module(module), attribute, None)
    home = str(getattr(value, "__module__", "")).partition(".")[0]
    if home not in _trusted_packages() or not isinstance(value, (type, FunctionType)):
        raise _refused(node, f"it names {name}")
    return value


def _make_object(loader: _ConfigLoader, suffix: str, node: yaml.Node) -> Iterator[Any]:
    kind = _named(suffix, node)
    if not isinstance(kind, type) or not dataclasses.is_dataclass(kind) or not isinstance(node, yaml.MappingNode):
        raise _refused(node, f"{suffix} is no configuration")
    made = kind.__new__(kind)
    yield made
    state = loader.construct_mapping(node, deep=True)
    # Setting a configuration up calls its target.
    if not isinstance(state.get("_target", type), type):
        raise _refused(node, f"the target of {suffix} is no class")
    for option in dataclasses.fields(kind):  # options newer than the run
        if option.name not in state and option.default_factory is not dataclasses.MISSING:
            state[option.name] = option.default_factory()
    vars(made).update(state)


def _make_value(loader: _ConfigLoader, suffix: str, node: yaml.Node) -> Any:
    """A path, or a member of an enumeration; other calls are refused."""
    arguments = loader.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else []
    if suffix.startswith("pathlib.") and suffix.endswith("Path") and all(isinstance(a, str) for a in arguments):
        return Path(*arguments)
    by_name = suffix == "builtins.getattr"  # as Python before 3.11.4 saves a member of an enumeration
    kind, *value = arguments if by_name and arguments else (_named(suffix, node), *arguments)
    if not isinstance(kind, type) or not issubclass(kind, Enum) or len(value) != 1:
        raise _refused(node, f"it asks to call {suffix}")
    return kind.__members__[value[0]] if by_name else kind(value[0])


_PYTHON = "tag:yaml.org,2002:python/"
_ConfigLoader.add_constructor(_PYTHON + "tuple", lambda loader, node: tuple(loader.construct_sequence(node, deep=True)))
_ConfigLoader.add_multi_constructor(_PYTHON + "name:", lambda loader, suffix, node: _named(suffix, node))
_ConfigLoader.add_multi_constructor(_PYTHON + "object:", _make_object)
_ConfigLoader.add_multi_constructor(_PYTHON + "object/apply:", _make_value)


def find_capture(config: Any, folder: Path) -> None:
    """If a run's capture is gone, look for it at the same place relative to the run, which may have moved too."""
    datamanager: Any = getattr(getattr(config, "pipeline", None), "datamanager", None)
    data = getattr(datamanager, "data", None)
    if not isinstance(data, Path) or data.exists():
        return
    names = ("output_dir", "experiment_name", "method_name", "timestamp")
    before = Path(*(str(getattr(config, name, "")) for name in names))
    if (moved := Path(os.path.normpath(folder / os.path.relpath(data, before)))).exists():
        datamanager.data = moved


def config_of(run: Path) -> Path:
    """Path of the ``config.yml`` of a run, given its folder or that file; it need not exist."""
    return run / "config.yml" if run.is_dir() else run


def find_config(path: Path) -> Path | None:
    """The ``config.yml`` of a run, given it, the run's folder, the folder of its checkpoints, or one of these."""
    folder = path if path.is_dir() else path.parent
    folders = [folder, folder.parent] if folder.name == "nerfstudio_models" else [folder]
    return next((each / "config.yml" for each in folders if (each / "config.yml").is_file()), None)


def load_config(path: Path) -> Any:
    """A run's ``config.yml`` as objects of nerfstudio, with the options that were saved; nothing is called.

    ``CheckpointError`` if it cannot be read, or asks for more than classes of nerfstudio, of this package, of torch,
    and of installed plug-ins.
    """
    config = _read(path, _ConfigLoader)
    find_capture(config, path.absolute().parent)
    return config


def _read(path: Path, loader: type[yaml.SafeLoader]) -> Any:
    remedy = "give the folder of a finished run, or its config.yml"
    with reading(path, "a run's config.yml, or of another version", CheckpointError, remedy=remedy, missing=remedy):
        return loader(regular(path).read_text(encoding="utf-8")).get_single_data()


class _ValueLoader(yaml.SafeLoader):
    """Makes plain values only: mappings for configurations, text for names, lists for tuples and calls."""


def _make_plain(loader: _ValueLoader, suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else suffix


_ValueLoader.add_multi_constructor(_PYTHON, _make_plain)


def value_of(path: Path, *keys: str) -> Any:
    """The plain value of a ``config.yml`` below these keys, or None; ``CheckpointError`` if the file cannot be read."""
    value = _read(path, _ValueLoader)
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value


def model_options(path: Path) -> dict[str, Any]:
    """Options of the model in a run's ``config.yml``; ``CheckpointError`` if it is no configuration of a run."""
    if not isinstance(options := value_of(path, "pipeline", "model"), dict):
        raise CheckpointError(f"{path} is not a run's config.yml; give the folder of a run")
    return options


def capture_and_source(path: Path) -> tuple[Path | None, Path | None]:
    """Paths of a run's capture and of the checkpoints that it resumes; ``CheckpointError`` if it cannot be read."""
    options = value_of(path)
    values = (options.get(name) if isinstance(options, dict) else None for name in ("data", "load_dir"))
    capture, source = (Path(*map(str, parts)) if isinstance(parts, list) and parts else None for parts in values)
    return capture, source


def schedule_length(path: Path) -> int:
    """Number of steps of a run's schedule; ``CheckpointError`` if it is no configuration of a run of ours."""
    if not isinstance(length := value_of(path, "schedule_length"), int):
        raise CheckpointError(f"{path} states no length of its schedule; give a run of sundae")
    return length


def check_run(run: Path) -> None:
    """``CheckpointError`` for a path that is no run, nor its ``config.yml``, before the slow import of nerfstudio."""
    if (kind := kind_of(run)) == "packed":
        raise CheckpointError(f"{run} is a packed scene; give the run that was packed")
    if kind is not None:
        raise CheckpointError(f"{run} is a {PRIMITIVES[kind]}, which sundae prune and sundae export read; give a run")
    if (reason := unread(run)) is not None:
        raise CheckpointError(f"{run} {reason}")
    model_options(config_of(run))
