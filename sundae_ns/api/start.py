"""How a scene is first seen: its start view and its up axis, as a user names them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from sundae_ns.api.scene import Scene
from sundae_ns.api.views import is_number, read_cameras
from sundae_ns.errors import ConfigError

Direction = tuple[float, float, float]


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
