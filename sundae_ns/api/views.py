"""Cameras: of a file, or made for a scene that comes without any."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from sundae_ns.api.scene import Scene
from sundae_ns.data.capture import finite, matrix, read_json, side
from sundae_ns.errors import ConfigError, DataError
from sundae_ns.gaussians import finite_mask
from sundae_ns.rendering import View

_INTRINSICS = ("fl_x", "fl_y", "cx", "cy")
_NEAREST, _FARTHEST = 0.3, 2.0
"""Distances of virtual eyes from the middle of the scene, as multiples of the median distance of its primitives."""
_FOV = 60.0
_FRONT_FOV = math.degrees(2 * math.atan(240 / 500))
"""Field of view in front of a scene, degrees: that of the web page."""


class CameraFile(NamedTuple):
    """The cameras of a file."""

    views: list[View]
    frames_per_second: float | None
    """Speed of a camera path; None for the cameras of a capture."""


def virtual_views(scene: Scene, n: int = 128, *, seed: int = 0, size: int = 128) -> list[View]:
    """Cameras that look at a scene from inside and around it, for scenes without cameras.

    Each eye is around the middle of the scene, at 0.3 to 2 times the median distance of the primitives, and looks at
    a random primitive.

    Args:
        scene: its finite primitives count.
        n: number of cameras.
        seed: of the random draws; the same on every device.
        size: width and height of the images, pixels.

    Raises:
        ConfigError: ``n`` or ``size`` is less than 1.
        DataError: no primitive is finite.

    >>> import torch, sundae_ns as sn
    >>> scene = sn.Scene.from_points(torch.rand(100, 3), torch.rand(100, 3))
    >>> len(sn.virtual_views(scene, 8))
    8
    """
    if n < 1 or size < 1:
        raise ConfigError(f"{n} views of {size} x {size} pixels see nothing; give at least 1 of both")
    means = scene.field["means"].detach()[finite_mask(scene.field)].cpu().double()
    if not len(means):
        raise DataError(f"none of {scene.num_primitives:,} primitives is finite, so no camera sees the scene")
    middle = means.median(dim=0).values
    reach = (means - middle).norm(dim=1).median().clamp_min(1e-6)
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=1)
    distance = _NEAREST + (_FARTHEST - _NEAREST) * torch.rand(n, 1, generator=generator, dtype=torch.float64)
    eyes = middle + reach * distance * direction
    targets = means[torch.randint(len(means), (n,), generator=generator)]
    pairs = zip(eyes, targets, strict=True)
    return [View.look_at(eye, target, fov=_FOV, width=size, height=size) for eye, target in pairs]


def view_in_front(scene: Scene) -> View:
    """A camera of 640 x 480 pixels for a scene without cameras: it looks along y, with z upwards."""
    means = scene.field["means"].detach().cpu()
    center = means.median(dim=0).values
    away = 3 * float((means - center).norm(dim=1).median().clamp_min(1e-6))
    return View.look_at(center - torch.tensor([0.0, away, 0.0]), center, fov=_FRONT_FOV)


def views_of(path: Path | str, scene: Scene | None = None) -> list[View]:
    """The cameras of a file, as ideal pinhole cameras: distortion is left out.

    Args:
        path: a ``transforms.json``, the folder with one, or a camera path of nerfstudio's viewer (``.json``).
        scene: whose coordinates the cameras are to have. A scene of a run needs it for a ``transforms.json``, because
            training has moved and scaled the capture.

    Raises:
        DataError: the file is missing, damaged, or holds no cameras.

    >>> import json, pathlib, tempfile, sundae_ns as sn
    >>> frame = {"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]}
    >>> camera = {"fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": [frame]}
    >>> path = pathlib.Path(tempfile.mkdtemp(), "camera.json")
    >>> _ = path.write_text(json.dumps(camera))
    >>> sn.views_of(path)[0].center
    tensor([0., 0., 3.])
    """
    return read_cameras(Path(path), scene).views


def read_cameras(path: Path, scene: Scene | None = None) -> CameraFile:
    """As :func:`views_of`, with the speed of a camera path."""
    path = path / "transforms.json" if path.is_dir() else path
    content = read_json(path)
    if "camera_path" in content:
        views, speed = _camera_path(content, path.name), finite(content.get("fps", 24), "fps", path.name, positive=True)
        return CameraFile(views, speed)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{path} holds neither frames nor a camera_path; give a transforms.json or a camera path")
    transform, scale = _to_model(scene, content, path.name)
    views = []
    for i, entry in enumerate(frames):
        where = f"{path.name}, frame {i}"
        stated = {**content, **entry} if isinstance(entry, dict) else {}
        pose = matrix(stated.get("transform_matrix"), (3, 4), "transform_matrix", where)
        intrinsics = [finite(stated.get(name), name, where, positive=name.startswith("fl")) for name in _INTRINSICS]
        size = [side(stated.get(name), name, where) for name in ("w", "h")]
        moved = transform[:3, :3] @ pose[:3]
        moved[:, 3] = scale * (moved[:, 3] + transform[:3, 3])
        views.append(View.from_pose(torch.from_numpy(moved), intrinsics, *size))
    return CameraFile(views, None)


def _to_model(scene: Scene | None, content: dict[str, Any], where: str) -> tuple[np.ndarray, float]:
    """Transform ``[4, 4]`` and then scale, from the coordinates of a ``transforms.json`` to those of a scene.

    A run states both from the coordinates before the transform that the file states as applied.
    """
    frame = scene.meta.get("frame") if scene is not None and scene.in_model_frame else None
    if frame is None:
        return np.eye(4), 1.0
    transform, applied = np.eye(4), np.eye(4)
    transform[:3] = np.asarray(frame["transform"], np.float64)[:3]
    if "applied_transform" in content:
        applied[:3] = matrix(content["applied_transform"], (3,), "applied_transform", where)
    scale = float(frame["scale"]) / finite(content.get("applied_scale", 1.0), "applied_scale", where, positive=True)
    return transform @ np.linalg.inv(applied), scale


def _camera_path(content: dict[str, Any], where: str) -> list[View]:
    """Views of a camera path of nerfstudio's viewer, which is in the coordinates of the model."""
    entries = content["camera_path"]
    if not isinstance(entries, list) or not entries:
        raise DataError(f"{where} has an empty camera_path; add keyframes in the viewer, and export it again")
    if content.get("camera_type", "perspective") != "perspective":
        raise DataError(f"{where} has cameras of type {content['camera_type']!r}; use perspective ones")
    width, height = (side(content.get(f"render_{name}"), f"render_{name}", where) for name in ("width", "height"))
    views = []
    for i, entry in enumerate(entries):
        place = f"{where}, camera {i}"
        flat = entry.get("camera_to_world") if isinstance(entry, dict) else None
        rows = [flat[k : k + 4] for k in range(0, 16, 4)] if isinstance(flat, list) and len(flat) == 16 else flat
        pose = matrix(rows, (4,), "camera_to_world", place)
        fov = finite(entry.get("fov", _FOV), "fov", place, positive=True)
        if not fov < 180:
            raise DataError(f"{place}: fov is {fov:g}; it must be below 180 degrees")
        views.append(View.from_fov(torch.from_numpy(pose), fov, width, height))
    return views


def is_frame(stated: Any) -> bool:
    """Whether a value states a transform ``[3 or 4, 4]`` and a scale, from a capture's coordinates to a model's."""
    if not isinstance(stated, dict) or not is_number(stated.get("scale")):
        return False
    rows = stated.get("transform")
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        return False
    return all(isinstance(row, list) and len(row) == 4 and all(map(is_number, row)) for row in rows)


def is_number(value: Any) -> bool:
    """Whether a value of JSON is a number that float64 holds."""
    try:
        return type(value) in (int, float) and math.isfinite(value)
    except OverflowError:
        return False
