"""What a run's folder says of itself, read without running it: nerfstudio's own reader of ``config.yml`` runs what it holds."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from sundae_ns.errors import CheckpointError, DataError, SundaeError

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras

CLASS = "class of the object"
"""Key under which :func:`read_config` keeps the name of an object's class."""

_PARSERS = ("ColmapDataParserConfig", "NerfstudioDataParserConfig")


class _PlainLoader(yaml.SafeLoader):
    """Reads objects of Python as plain mappings, lists and strings; nothing is imported, nothing is called."""


def _plain(loader: _PlainLoader, suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return {**loader.construct_mapping(node, deep=True), CLASS: suffix}
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return suffix


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def read_config(path: Path) -> dict[str, Any]:
    """A run's ``config.yml`` as plain mappings, lists, strings and numbers; paths are lists of their parts.

    Raises:
        CheckpointError: it cannot be read, or is no configuration.
    """
    try:
        loaded = yaml.load(path.read_text(encoding="utf-8"), Loader=_PlainLoader)
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({error.strerror}); give a run's folder") from error
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise CheckpointError(f"{path} is not a run's config.yml ({reason}); give a run's folder") from error
    if not isinstance(loaded, dict) or not isinstance(loaded.get("pipeline"), dict):
        raise CheckpointError(f"{path} is not a run's config.yml; give a run's folder")
    return loaded


def prunes_before(path: Path, step: int) -> list[dict[str, Any]]:
    """Records of the prunes of a run before a step, from its ``prune.json``; none if there is no such file.

    A file that cannot be read is set aside under another name: it is no reason to end a training.
    """
    try:
        records = json.loads(path.read_text(encoding="utf-8"))
        return [record for record in records if record["step"] < step]
    except FileNotFoundError:
        return []
    except (ValueError, TypeError, KeyError):
        path.replace(path.with_suffix(".damaged.json"))
        return []


def config_of(run: Path) -> Path:
    """Where the ``config.yml`` of a run lies that is named by its folder, or by that file; whether it is there is not asked."""
    return run / "config.yml" if run.is_dir() else run


def find_config(path: Path) -> Path | None:
    """The ``config.yml`` of the run that a path belongs to: the file, the run's folder, its checkpoints or one of them."""
    if path.name == "config.yml" and path.is_file():
        return path
    folder = path if path.is_dir() else path.parent
    places = [folder, folder.parent] if folder.name == "nerfstudio_models" else [folder]
    return next((place / "config.yml" for place in places if (place / "config.yml").is_file()), None)


def training_cameras(config: Mapping[str, Any]) -> Cameras:
    """Training cameras of a run in the coordinates of its field, on the CPU, from the capture that it was trained on.

    Args:
        config: from :func:`read_config`, of a run on a capture of nerfstudio's or of COLMAP's layout.

    Raises:
        DataError: the capture is not there, is of another layout, or cannot be used.
    """
    manager = config["pipeline"].get("datamanager")
    stored = manager.get("dataparser") if isinstance(manager, Mapping) else None
    name = str(stored.get(CLASS)).rpartition(".")[2] if isinstance(stored, Mapping) else ""
    if not isinstance(manager, Mapping) or not isinstance(stored, Mapping) or name not in _PARSERS:
        raise DataError("the run's capture is of another layout than nerfstudio-data and colmap")
    data = _path(manager.get("data")) or _path(config.get("data")) or _path(stored.get("data"))
    if data is None:
        raise DataError("the run does not say where its capture is")

    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    from sundae_ns.datamanager import LightNerfstudioParser, check_capture

    parser: Any
    if name == "ColmapDataParserConfig":
        parser = ColmapDataParserConfig(data=data)
    else:
        parser = NerfstudioDataParserConfig(_target=LightNerfstudioParser, data=data)
    for field in dataclasses.fields(parser):
        value, default = stored.get(field.name), getattr(parser, field.name)
        if isinstance(default, Path) and field.name != "data":
            setattr(parser, field.name, _path(value) or default)
        elif field.name in stored and isinstance(value, (str, int, float, type(None))) and field.name != "_target":
            setattr(parser, field.name, value)
    parser.load_3D_points = False
    try:
        check_capture(parser, data, ("train",), pictures=False)
        cameras: Cameras = parser.setup().get_dataparser_outputs(split="train").cameras
    except SundaeError:
        raise
    except (Exception, EOFError) as error:  # parsers raise many kinds, assertions too; each means the same to the user
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(f"{data} cannot be parsed ({reason})") from error
    if len(cameras) == 0:
        raise DataError(f"{data} has no training views")
    return cameras


def _path(value: Any) -> Path | None:
    """A path as :func:`read_config` leaves it."""
    parts = [value] if isinstance(value, str) else value
    return Path(*parts) if isinstance(parts, list) and parts and all(isinstance(p, str) for p in parts) else None
