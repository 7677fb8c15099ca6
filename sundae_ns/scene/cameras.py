"""Cameras of a scene: those of a file, one in front of it, and its start view."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from sundae_ns.core.camera import OPENGL_TO_OPENCV, Camera
from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.data.capture import finite, matrix, read_json, rigid, side
from sundae_ns.data.colmap import read_images
from sundae_ns.data.lenses import kind_of_frame, with_focal_lengths
from sundae_ns.scene.scene import Scene

Direction = tuple[float, float, float]


class CameraFile(NamedTuple):
    """Cameras of a file, with the frames per second of a camera path; None for those of a capture."""

    cameras: list[Camera]
    frames_per_second: float | None


def camera_in_front(scene: Scene) -> Camera:
    """A camera of 640 x 480 pixels for a scene without cameras: with z upwards it looks along y."""
    means = scene.gaussians["means"].detach().cpu()
    center = means.median(dim=0).values
    away = 3 * float((means - center).norm(dim=1).median().clamp_min(1e-6))
    up = torch.tensor(scene.up or (0.0, 0.0, 1.0))
    side = torch.tensor([1.0, 0.0, 0.0] if abs(float(up[0])) < 0.9 else [0.0, 1.0, 0.0])
    back = torch.nn.functional.normalize(torch.linalg.cross(side, up), dim=0)
    fov = 2 * math.degrees(math.atan(240 / 500))  # that of the web page
    return Camera.look_at(center + away * back, center, up, fov=fov)


def cameras_of(path: Path | str, scene: Scene | None = None) -> list[Camera]:
    """The cameras of a file, as ideal pinhole cameras: distortion is left out.

    Args:
        path: a ``transforms.json``, the folder with one, a COLMAP model (such as ``sparse/0``), or a camera path of
            nerfstudio's viewer (``.json``).
        scene: whose coordinates the cameras are to have. A scene of a run needs it for the cameras of its capture,
            because training has moved and scaled them.

    Raises:
        DataError: the file is missing, damaged, or holds no cameras.

    >>> import json, pathlib, tempfile, sundae_ns as sn
    >>> frame = {"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]}
    >>> camera = {"fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": [frame]}
    >>> path = pathlib.Path(tempfile.mkdtemp(), "camera.json")
    >>> _ = path.write_text(json.dumps(camera), encoding="utf-8")
    >>> sn.cameras_of(path)[0].center
    tensor([0., 0., 3.])
    """
    return read_cameras(Path(path), scene).cameras


def read_cameras(path: Path, scene: Scene | None = None) -> CameraFile:
    """As :func:`cameras_of`, with the speed of a camera path."""
    if path.is_dir() and any((path / name).exists() for name in ("cameras.bin", "cameras.txt")):
        return CameraFile(_of_colmap(path, scene), None)
    path = path / "transforms.json" if path.is_dir() else path
    content = read_json(path)
    if "camera_path" in content:
        speed = finite(content.get("fps", 24), "fps", path.name, positive=True)
        return CameraFile(_camera_path(content, path.name), speed)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{path} holds neither frames nor a camera_path; give a transforms.json or a camera path")
    content = with_focal_lengths(content, path.parent)
    transform, scale = _to_model(scene, content, path.name)
    cameras = []
    for i, entry in enumerate(frames):
        where = f"{path.name}, frame {i}"
        stated = {**content, **entry} if isinstance(entry, dict) else {}
        kind_of_frame(stated, where)
        pose = rigid(matrix(stated.get("transform_matrix"), (3, 4), "transform_matrix", where), where)
        names = ("fl_x", "fl_y", "cx", "cy")
        intrinsics = [finite(stated.get(name), name, where, positive=name.startswith("fl")) for name in names]
        size = [side(stated.get(name), name, where) for name in ("w", "h")]
        cameras.append(_moved(pose, transform, scale, intrinsics, *size))
    return CameraFile(cameras, None)


def _moved(
    pose: np.ndarray, transform: np.ndarray, scale: float, intrinsics: Sequence[float], width: int, height: int
) -> Camera:
    """The camera of a pose, camera-to-world with OpenGL axes ``[3 or 4, 4]``, after a transform and then a scale."""
    moved = transform[:3, :3] @ pose[:3]
    moved[:, 3] = scale * (moved[:, 3] + transform[:3, 3])
    return Camera.from_pose(torch.from_numpy(moved), intrinsics, width, height)


def _of_colmap(model: Path, scene: Scene | None) -> list[Camera]:
    """Cameras of a COLMAP model, in its own coordinates or in those of a run trained on it."""
    transform, scale = _to_model(scene, {}, model.name)
    cameras = []
    for image in read_images(model).values():
        quaternion, translation = torch.tensor(image.pose, dtype=torch.float64).split([4, 3])
        rotation = rotation_matrices(quaternion[None])[0].T
        pose = torch.cat([rotation * rotation.new_tensor(OPENGL_TO_OPENCV), -(rotation @ translation)[:, None]], dim=1)
        camera = image.camera
        cameras.append(_moved(pose.numpy(), transform, scale, camera.intrinsics, camera.width, camera.height))
    return cameras


def _to_model(scene: Scene | None, content: dict[str, Any], where: str) -> tuple[np.ndarray, float]:
    """Transform ``[4, 4]`` and then scale, from the coordinates of a ``transforms.json`` to those of a scene.

    A run states both relative to the capture before its ``applied_transform``.
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


def _camera_path(content: dict[str, Any], where: str) -> list[Camera]:
    """Cameras of a path of nerfstudio's viewer, in the coordinates of the model."""
    entries = content["camera_path"]
    if not isinstance(entries, list) or not entries:
        raise DataError(f"{where} has an empty camera_path; add keyframes in the viewer, and export it again")
    if content.get("camera_type", "perspective") != "perspective":
        raise DataError(f"{where} has cameras of type {content['camera_type']!r}; use perspective ones")
    width, height = (side(content.get(f"render_{name}"), f"render_{name}", where) for name in ("width", "height"))
    cameras = []
    for i, entry in enumerate(entries):
        named = f"{where}, camera {i}"
        flat = entry.get("camera_to_world") if isinstance(entry, dict) else None
        rows = [flat[k : k + 4] for k in range(0, 16, 4)] if isinstance(flat, list) and len(flat) == 16 else flat
        pose = matrix(rows, (4,), "camera_to_world", named)
        fov = finite(entry.get("fov", 60.0), "fov", named, positive=True)
        if not fov < 180:
            raise DataError(f"{named}: fov is {fov:g}; it must be below 180 degrees")
        cameras.append(Camera.from_fov(torch.from_numpy(pose), fov, width, height))
    return cameras


def is_frame(stated: Any) -> bool:
    """Whether a value states a transform ``[3 or 4, 4]`` and a scale, from a capture's coordinates to a model's."""
    rows = stated.get("transform") if isinstance(stated, dict) and is_number(stated.get("scale")) else None
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        return False
    return all(isinstance(row, list) and len(row) == 4 and all(map(is_number, row)) for row in rows)


def is_number(value: Any) -> bool:
    """Whether a value of JSON is a number that float64 holds."""
    try:
        return type(value) in (int, float) and math.isfinite(value)
    except OverflowError:
        return False


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
    """The scene with another start view or up axis, as a user names them; None keeps that of the scene.

    Args:
        scene: whose stored cameras an index counts.
        start_view: index of a stored camera, or a file whose first camera it is (:func:`sundae_ns.cameras_of`).
        up: direction ``[3]`` of any length.

    Raises:
        ConfigError: there is no such view, or the direction is zero.
        DataError: the file holds no cameras.
    """
    if up is not None:
        scene = dataclasses.replace(scene, up=unit(up))
    if start_view is None:
        return scene
    if not start_view.lstrip("-").isdigit():
        return dataclasses.replace(scene, start=read_cameras(Path(start_view), scene).cameras[0])
    count = len(scene.cameras)
    if not count:
        raise ConfigError("the scene has no stored cameras; give --start-view a camera file")
    if not 0 <= int(start_view) < count:
        raise ConfigError(f"there is no camera {start_view}; give --start-view 0 to {count - 1}, or a camera file")
    return dataclasses.replace(scene, start=scene.cameras[int(start_view)])
