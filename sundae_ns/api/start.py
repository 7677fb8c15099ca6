"""How a scene is first seen: its start view and its up axis, as JSON values of a packed file or of a run's folder."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from sundae_ns.api.scene import Scene
from sundae_ns.api.views import is_number, read_cameras
from sundae_ns.errors import ConfigError
from sundae_ns.rendering.views import View
from sundae_ns.storage.packing.schema import FORMAT, fault

_PROPERTIES: dict[str, Any] = FORMAT["header"]["properties"]
START_FILE = "start.json"
"""The same values in the folder of an unpacked run."""

Direction = tuple[float, float, float]


def stated_start(scene: Scene) -> dict[str, Any]:
    """Entries ``up`` and ``start`` of a packed file's header; without those that the scene does not know.

    Raises:
        ConfigError: readers would refuse them.
    """
    stated: dict[str, Any] = {}
    if scene.up is not None:
        stated["up"] = [float(value) for value in scene.up]
    if scene.start is not None:
        view = scene.start
        stated["start"] = {
            "pose": view.pose.double().tolist(),
            "intrinsics": view.K.double()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
            "size": [view.width, view.height],
        }
    for name, value in stated.items():
        if not all(map(is_number, _numbers(value))) or fault(value, _PROPERTIES[name]) is not None:
            named = "start view" if name == "start" else "up axis"
            raise ConfigError(f"the {named} of the scene has values that readers refuse; give another one")
    return stated


def _numbers(value: Any) -> list[Any]:
    if isinstance(value, (dict, list)):
        return [
            number for inner in (value.values() if isinstance(value, dict) else value) for number in _numbers(inner)
        ]
    return [value]


def start_of(stated: Mapping[str, Any]) -> tuple[Direction | None, View | None]:
    """Up axis and start view of JSON values; None for one that is missing, or that the schema refuses."""
    good = {name: stated[name] for name in ("up", "start") if name in stated}
    good = {name: value for name, value in good.items() if fault(value, _PROPERTIES[name]) is None}
    view = None
    if "start" in good:
        start = good["start"]
        pose = torch.tensor(start["pose"], dtype=torch.float64)
        view = View.from_pose(pose, start["intrinsics"], *start["size"])
    return unit(good["up"]) if "up" in good else None, view


def unit(direction: Sequence[float]) -> Direction:
    """A direction scaled to unit length; ``ConfigError`` for one without a direction."""
    if len(direction) != 3 or not all(map(is_number, direction)):
        raise ConfigError("the up axis is not three finite numbers; give 0 0 1 for z")
    length = math.hypot(*direction)
    if not 0 < length < math.inf:
        raise ConfigError("the up axis has no direction; give 0 0 1 for z")
    x, y, z = (float(value) / length for value in direction)
    return x, y, z


def with_start(scene: Scene, start_view: str | None, up: Sequence[float] | None) -> Scene:
    """The scene with another start view or up axis, as a user names them.

    Args:
        scene: whose stored views an index counts.
        start_view: index of a stored view, or a file whose first camera it is (:func:`sundae_ns.views_of`); None keeps
            that of the scene.
        up: direction ``[3]`` of any length; None keeps that of the scene.

    Raises:
        ConfigError: there is no such view, or the direction is zero.
        DataError: the file holds no cameras.
    """
    if up is not None:
        scene = dataclasses.replace(scene, up=unit(up))
    if start_view is None:
        return scene
    if not start_view.lstrip("-").isdigit():
        return dataclasses.replace(scene, start=read_cameras(Path(start_view), scene).views[0])
    count = len(scene.views)
    if not count:
        raise ConfigError("the scene has no stored cameras; give --start-view a camera file")
    if not 0 <= int(start_view) < count:
        raise ConfigError(f"there is no camera {start_view}; give --start-view 0 to {count - 1}, or a camera file")
    return dataclasses.replace(scene, start=scene.views[int(start_view)])
