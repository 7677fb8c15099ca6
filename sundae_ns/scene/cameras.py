"""Cameras of a scene: those of a file, its start view, and a path for a film."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from contextlib import suppress
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sundae_ns.core.camera import OPENGL_TO_OPENCV, Camera, poses_looking_at, world_to_camera
from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.core.files import at_home
from sundae_ns.data.capture import finite, matrix, read_json, rigid, side
from sundae_ns.data.colmap import read_images
from sundae_ns.data.layouts import is_model, models_in
from sundae_ns.data.lenses import INTRINSICS, kind_of_frame, with_focal_lengths
from sundae_ns.scene.scene import Scene, unit
from sundae_ns.scene.virtual_cameras import FOV, front_views

MOST_FRAMES = 36_000  # of a film: 25 minutes
MOST_CAMERAS = 10_000  # of a file
_STOPS = 8  # of a film; all orders of more take long
_STEEP = 0.95  # largest sine of a camera's pitch; steeper ones have no upright image
Array = NDArray[np.float64]
Pinhole = tuple[np.ndarray, Sequence[float], int, int]  # OpenGL camera-to-world [3 or 4, 4], fx fy cx cy, width, height


def opening(scene: Scene) -> Scene:
    """The scene with a start view if it has neither that nor cameras: the first of :func:`.front_views`."""
    return scene if scene.start or scene.cameras else dataclasses.replace(scene, start=front_views(scene, 1)[0])


def cameras_of(path: Path | str, scene: Scene | None = None) -> list[Camera]:
    """The cameras of a file, as ideal pinhole cameras without distortion.

    Args:
        path: a ``transforms.json``, a COLMAP model, a folder with one of them, or a camera path of nerfstudio's viewer.
        scene: whose coordinates the cameras get; needed for a run's scene, as training moves and scales its capture.

    Raises:
        DataError: the file is missing, damaged, or holds no cameras; or the scene does not place those of its capture.

    >>> import json, pathlib, tempfile, sundae_ns as sn
    >>> frame = {"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]}
    >>> camera = {"fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": [frame]}
    >>> path = pathlib.Path(tempfile.mkdtemp(), "camera.json")
    >>> _ = path.write_text(json.dumps(camera), encoding="utf-8")
    >>> sn.cameras_of(path)[0].center
    tensor([0., 0., 3.])
    """
    return read_cameras(at_home(path), scene)[0]


def read_cameras(path: Path, scene: Scene | None = None) -> tuple[list[Camera], float | None]:
    """As :func:`cameras_of`, with the frames per second of a camera path; None for other files."""
    stated = path / "transforms.json" if path.is_dir() else path
    models = [path] if is_model(path) else [] if stated.exists() else [path / name for name in models_in(path)]
    path = models[0] if models else stated
    remedy = "give a transforms.json, the folder of a COLMAP model, or a camera path"
    content: dict[str, Any] = {} if models else with_focal_lengths(read_json(path, remedy=remedy), path.parent)
    entries: Any = [*read_images(path).values()] if models else content.get("camera_path", content.get("frames"))
    if not isinstance(entries, list) or not entries:
        raise DataError(f"{path} holds neither frames nor a camera_path; {remedy}")
    if len(entries) > MOST_CAMERAS:
        raise DataError(f"{path.name} has {len(entries):,} cameras; give at most {MOST_CAMERAS:,}")
    read = _of_path if "camera_path" in content else _of_frame if content else _of_colmap
    transform, scale = _to_model(scene, content, path.name)
    cameras: list[Camera] = []
    for i, entry in enumerate(entries):
        pose, intrinsics, width, height = read(entry, content, f"{path.name}, frame {i}")
        moved = transform[:3, :3] @ pose[:3]
        moved[:, 3] = scale * (moved[:, 3] + transform[:3, 3])
        cameras.append(Camera.from_pose(torch.from_numpy(moved), intrinsics, width, height))
    return cameras, finite(content.get("fps", 24), "fps", path.name, positive=True) if read is _of_path else None


def _of_frame(entry: Any, content: dict[str, Any], where: str) -> Pinhole:
    """A camera of a ``transforms.json``."""
    stated = {**content, **entry} if isinstance(entry, dict) else {}
    kind_of_frame(stated, where)
    pose = rigid(matrix(stated.get("transform_matrix"), (3, 4), "transform_matrix", where), where)
    intrinsics = [finite(stated.get(name), name, where, positive=name.startswith("fl")) for name in INTRINSICS[:4]]
    return pose, intrinsics, side(stated.get("w"), "w", where), side(stated.get("h"), "h", where)


def _of_colmap(image: Any, _: dict[str, Any], __: str) -> Pinhole:
    """A camera of a COLMAP model."""
    quaternion, translation = torch.tensor(image.pose, dtype=torch.float64).split([4, 3])
    rotation = rotation_matrices(quaternion[None])[0].T
    pose = torch.cat([rotation * rotation.new_tensor(OPENGL_TO_OPENCV), -(rotation @ translation)[:, None]], dim=1)
    return pose.numpy(), image.camera.intrinsics, image.camera.width, image.camera.height


def _of_path(entry: Any, content: dict[str, Any], where: str) -> Pinhole:
    """A camera of a path of nerfstudio's viewer."""
    if content.get("camera_type", "perspective") != "perspective":
        raise DataError(f"{where} has cameras of type {content['camera_type']!r}; use perspective ones")
    width, height = (side(content.get(f"render_{name}"), f"render_{name}", where) for name in ("width", "height"))
    flat = entry.get("camera_to_world") if isinstance(entry, dict) else None
    rows = [flat[k : k + 4] for k in range(0, 16, 4)] if isinstance(flat, list) and len(flat) == 16 else flat
    pose = rigid(matrix(rows, (4,), "camera_to_world", where), where)
    if not (fov := finite(entry.get("fov", 60.0), "fov", where, positive=True)) < 180:
        raise DataError(f"{where}: fov is {fov:g}; it must be below 180 degrees")
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    return pose, (focal, focal, width / 2, height / 2), width, height


def _to_model(scene: Scene | None, content: dict[str, Any], where: str) -> tuple[np.ndarray, float]:
    """Transform ``[4, 4]`` and then scale, from the coordinates of a ``transforms.json`` to those of a scene."""
    if scene is None or "camera_path" in content or not (scene.in_model_frame or "frame" in scene.meta):
        return np.eye(4), 1.0  # a path is one of the viewer, which shows the model
    if (frame := scene.meta.get("frame")) is None:  # as of a .ply by ns-export
        raise DataError(f"{where}: the scene does not state where cameras of its capture are; give its run, or a path")
    transform, applied = np.eye(4), np.eye(4)  # a run states its transform for the capture before the applied one
    transform[:3] = np.asarray(frame["transform"], np.float64)[:3]
    applied[:3] = matrix(content.get("applied_transform", np.eye(3, 4)), (3,), "applied_transform", where)
    scale = float(frame["scale"]) / finite(content.get("applied_scale", 1.0), "applied_scale", where, positive=True)
    return transform @ np.linalg.inv(applied), scale


def is_frame(stated: Any) -> bool:
    """Whether a value states a transform ``[3 or 4, 4]`` and a scale, from a capture's coordinates to a model's."""
    with suppress(DataError, KeyError, TypeError):
        matrix(stated["transform"], (3, 4), "transform", "frame")
        finite(stated["scale"], "scale", "frame", positive=True)
        return True
    return False


def spread(total: int, most: int) -> list[int]:
    """At most ``most`` indices below ``total``, evenly spaced from the first to the last."""
    return torch.linspace(0, total - 1, min(most, total)).round().int().tolist()


def with_start(scene: Scene, start_view: str | None, up: Sequence[float] | None) -> Scene:
    """The scene with another up axis or start view, an index of a stored camera (else ``ConfigError``) or a file."""
    scene = scene if up is None else dataclasses.replace(scene, up=unit(up))
    if start_view is None:
        return scene
    if not start_view.removeprefix("-").isdecimal():
        return dataclasses.replace(scene, start=cameras_of(start_view, scene)[0])
    if not 0 <= int(start_view) < len(scene.cameras):
        stored = f"--start-view 0 to {len(scene.cameras) - 1}, or a camera file" if scene.cameras else "a camera file"
        raise ConfigError(f"there is no camera {start_view} in the scene; give {stored}")
    return dataclasses.replace(scene, start=scene.cameras[int(start_view)])


def film_views(scene: Scene, *, seconds: float = 12.0, frames_per_second: float = 24.0) -> list[Camera]:
    """Cameras of a film, one a frame, along a closed, smooth path at an even speed of motion and turning, upright.

    It leads through up to eight stored cameras, from the start view, else the first, on the shortest way; with fewer
    than three through :func:`.front_views`. Up is that of the scene, else the mean of its cameras', else z; lens and
    shape are those of the first camera, with at most 1,280 pixels a side. ``ConfigError`` for an impossible length.
    """
    count = round(seconds * frames_per_second) if math.isfinite(seconds * frames_per_second) else 0
    if not (1 <= count <= MOST_FRAMES and seconds > 0):
        length = f"{seconds:g} s and {frames_per_second:g} frames a second"
        raise ConfigError(f"a film of {length} is impossible; give 1 to {MOST_FRAMES:,} frames")
    up = np.array(scene.up or (0.0, 0.0, 1.0))
    if scene.up is None and scene.cameras:
        mean = torch.stack([camera.pose[:, 1] for camera in scene.cameras]).double().mean(dim=0)
        up = np.array(unit(mean.tolist())) if float(mean.norm()) > 1e-3 else up
    stored = [camera for camera in (scene.start, *scene.cameras) if camera is not None]
    lens = stored[0] if stored else Camera.from_fov(torch.eye(4), FOV, 1280, 720)
    different = {str(camera.pose.double().round(decimals=5).tolist()): camera for camera in stored}
    cameras = [camera for camera in different.values() if abs(camera.pose[:, 2].double().numpy() @ up) < _STEEP]
    cameras = cameras if len(cameras) >= 3 else front_views(dataclasses.replace(scene, up=unit(up)))
    poses = np.array([camera.pose.double().tolist() for camera in cameras])
    eyes, ahead = poses[:, :, 3], -poses[:, :, 2]
    scale = max(float(np.median(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1))), 1e-9)
    path = _even(_tour(np.hstack([eyes / scale, ahead])), up, count)  # a unit of motion counts as a turn by a radian
    centers = torch.from_numpy(path[:, :3] * scale)
    moved = poses_looking_at(centers, centers + torch.from_numpy(path[:, 3:]), torch.from_numpy(up))
    lens = lens.zoomed(min(1280 / max(lens.width, lens.height), 1.0))
    return [lens._replace(viewmat=viewmat) for viewmat in world_to_camera(moved.float())]


def _tour(points: Array) -> Array:
    """At most eight points of ``[N, C]``, the first and typical others, in the order of the shortest way back."""
    chosen = list(range(len(points)))
    if len(points) > _STOPS:
        from scipy.cluster.vq import kmeans2  # takes long, and a file of cameras needs none

        centers, _ = kmeans2(points, _STOPS, minit="++", rng=np.random.default_rng(0))
        centers = np.delete(centers, np.linalg.norm(centers - points[0], axis=1).argmin(), axis=0)
        chosen = [0, *(int(np.linalg.norm(points - center, axis=1).argmin()) for center in centers)]
    keys = points[sorted(set(chosen))]
    apart = np.linalg.norm(keys[:, None] - keys, axis=2)
    orders = np.array([(0, *order, 0) for order in permutations(range(1, len(keys)))])
    return keys[orders[apart[orders[:, :-1], orders[:, 1:]].sum(axis=1).argmin()][:-1]]


def _even(keys: Array, up: Array, count: int) -> Array:
    """Places and directions ``[count, 6]`` at an even speed on a smooth closed way through keys ``[K, 6]``."""
    from scipy.interpolate import CubicSpline

    knots = []
    for here, there in zip(keys, np.roll(keys, -1, axis=0), strict=True):
        knots.append(here)
        side = np.cross(up, here[3:] - there[3:])  # 0 from one pitch to another
        if here[3:] @ there[3:] < -0.5 and np.linalg.norm(side) > 0.2:  # a spline would flip: look to the side
            knots.append(np.hstack([(here[:3] + there[:3]) / 2, side / np.linalg.norm(side)]))
    ends = np.array([*knots, knots[0]])
    # Parameters of square roots of distances keep the spline from swinging out (centripetal).
    times = np.hstack([0.0, np.sqrt(np.linalg.norm(np.diff(ends, axis=0), axis=1)).clip(1e-3).cumsum()])
    spline = CubicSpline(times, ends, bc_type="periodic")

    def at(moments: Array) -> Array:
        path: Array = spline(moments)
        ahead = path[:, 3:] / np.linalg.norm(path[:, 3:], axis=1, keepdims=True).clip(1e-9)
        rise = (ahead @ up)[:, None]
        flat = ahead - rise * up
        rise = rise.clip(-_STEEP, _STEEP)
        flat *= np.sqrt(1 - rise**2) / np.linalg.norm(flat, axis=1, keepdims=True).clip(1e-9)
        return np.hstack([path[:, :3], rise * up + flat])

    fine = np.linspace(0.0, times[-1], 64 * len(knots))
    lengths = np.hstack([0.0, np.linalg.norm(np.diff(at(fine), axis=0), axis=1).cumsum()])
    return at(np.interp(np.arange(count) / count * lengths[-1], lengths, fine))
