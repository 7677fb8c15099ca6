"""The cameras of a film: a closed, smooth path among the cameras of a scene, or a circle around it."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.interpolate import CubicSpline

from sundae_ns.core.camera import Camera, poses_looking_at
from sundae_ns.core.errors import ConfigError
from sundae_ns.scene.cameras import unit
from sundae_ns.scene.scene import Scene
from sundae_ns.scene.virtual_cameras import FOV, middle_and_reach, virtual_cameras

MOST_FRAMES = 36_000  # 25 minutes
_STEEP = 0.95  # largest sine of a camera's pitch; steeper ones have no upright image
Array = NDArray[np.float64]


def film_views(scene: Scene, *, seconds: float = 12.0, frames_per_second: float = 24.0) -> list[Camera]:
    """Cameras of a film of a scene, along a closed and smooth path at an even speed; upright, without roll.

    The path leads through up to eight stored cameras, from the start view, else the first, on the shortest way, and
    looks where they look. A scene with fewer than three cameras is seen from a circle around its middle. The speed is
    that of motion and turning together.

    Args:
        scene: its up axis, else the mean of its cameras', else z, is upwards in the images.
        seconds: length of the film.
        frames_per_second: number of cameras a second.

    Returns:
        One camera a frame, with the lens and the shape of the first camera's images, at most 1,280 pixels a side.

    Raises:
        ConfigError: there is not even one frame, or there are more than :data:`MOST_FRAMES`.
        DataError: the scene has no finite Gaussian.
    """
    count = round(seconds * frames_per_second) if math.isfinite(seconds * frames_per_second) else 0
    if not (1 <= count <= MOST_FRAMES and seconds > 0):
        raise ConfigError(
            f"a film of {seconds:g} s and {frames_per_second:g} frames a second is impossible; "
            f"give 1 to {MOST_FRAMES:,} frames"
        )
    up = _up_of(scene)
    cameras = [camera for camera in (scene.start, *scene.cameras) if camera is not None]
    lens = cameras[0] if cameras else Camera.from_fov(torch.eye(4), FOV, 1280, 720)
    poses = np.array([camera.pose.double().tolist() for camera in cameras]).reshape(-1, 3, 4)
    poses = poses[np.abs(poses[:, :, 2] @ up) < _STEEP]
    poses = poses[np.sort(np.unique(poses.round(5), axis=0, return_index=True)[1])]
    eyes, ahead = (poses[:, :, 3], -poses[:, :, 2]) if len(poses) >= 3 else _circle(scene, up)
    # One unit of motion counts as much as a turn by a radian.
    scale = max(float(np.median(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1))), 1e-9)
    keys = _tour(np.hstack([eyes / scale, ahead]))
    path = _even(keys, up, count)
    centers = torch.from_numpy(path[:, :3] * scale)
    moved = poses_looking_at(centers, centers + torch.from_numpy(path[:, 3:]), torch.from_numpy(up))
    lens = lens.zoomed(min(1280 / max(lens.width, lens.height), 1.0))
    intrinsics = [float(lens.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return [Camera.from_pose(pose, intrinsics, lens.width, lens.height) for pose in moved]


def _up_of(scene: Scene) -> Array:
    up = scene.up
    if up is None and scene.cameras:
        mean = torch.stack([camera.pose[:, 1] for camera in scene.cameras]).double().mean(dim=0)
        up = unit(mean.tolist()) if float(mean.norm()) > 1e-3 else None
    return np.array(up or (0.0, 0.0, 1.0))


def _circle(scene: Scene, up: Array) -> tuple[Array, Array]:
    """Eyes on a circle, at the median distance and height of the virtual cameras, and directions to its middle."""
    middle, reach = middle_and_reach(scene)
    center = middle.numpy()
    arms = np.stack([camera.center.double().numpy() for camera in virtual_cameras(scene, 48)]) - center
    height = np.median(arms @ up).clip(-0.5 * reach, 0.5 * reach)
    side = np.cross(up, np.roll(up, 1) + [1e-3, 0.0, 0.0])
    side /= np.linalg.norm(side)
    angles = np.arange(8) * (math.pi / 4)
    radius = np.median(np.linalg.norm(arms, axis=1))
    arms = radius * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(up, side)) + height * up
    return center + arms, -arms / np.linalg.norm(arms, axis=1, keepdims=True)


def _tour(points: Array, most: int = 8) -> Array:
    """The first of points ``[N, C]`` and at most ``most - 1`` typical others, in the order of the shortest way back."""
    chosen = [0]
    if len(points) > most:
        centers, _ = kmeans2(points, most, minit="++", rng=np.random.default_rng(0))
        centers = np.delete(centers, np.linalg.norm(centers - points[0], axis=1).argmin(), axis=0)
        chosen += [int(np.linalg.norm(points - center, axis=1).argmin()) for center in centers]
    else:
        chosen += range(1, len(points))
    keys = points[sorted(set(chosen))]
    apart = np.linalg.norm(keys[:, None] - keys, axis=2)
    orders = np.array([(0, *order, 0) for order in permutations(range(1, len(keys)))])
    return keys[orders[apart[orders[:, :-1], orders[:, 1:]].sum(axis=1).argmin()][:-1]]


def _even(keys: Array, up: Array, count: int) -> Array:
    """Places and directions ``[count, 6]`` at an even speed on a smooth closed way through keys ``[K, 6]``."""
    knots = []
    for here, there in zip(keys, np.roll(keys, -1, axis=0), strict=True):
        knots.append(here)
        if here[3:] @ there[3:] < -0.5:  # between opposite directions a spline would flip: look to the side
            side = np.cross(up, here[3:] - there[3:])
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
