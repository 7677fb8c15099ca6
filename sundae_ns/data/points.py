"""A sparse point cloud as structure from motion would give it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sundae_ns.data.cameras import Camera, in_frame, pixel_rays, project
from sundae_ns.data.shapes import Array
from sundae_ns.data.tracer import Scene, first_hits, shade

MIN_VIEWS = 2
"""Cameras that must see a point: it takes two rays to triangulate one."""


def _detail(picture: Array) -> Array:
    """Chance of a feature at each pixel ``[H, W]``: strong where the brightness changes, small but not 0 elsewhere."""
    down, right = np.gradient(picture.mean(axis=2, dtype=np.float64))
    return np.hypot(down, right) + 0.01


def _surface_points(
    scene: Scene, cameras: Sequence[Camera], pictures: Sequence[Array], count: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Points under ``count`` pixels drawn by detail: positions ``[M, 3]``, owner bodies ``[M]``, distances ``[M]``."""
    origins, directions = [], []
    for camera, picture, share in zip(cameras, pictures, np.array_split(np.arange(count), len(cameras)), strict=True):
        weights = _detail(picture).ravel()
        pixels = rng.choice(len(weights), size=len(share), p=weights / weights.sum())
        o, d = pixel_rays(camera, pixels % camera.width + 0.5, pixels // camera.width + 0.5)
        origins.append(o)
        directions.append(d)
    o, d = np.concatenate(origins), np.concatenate(directions)
    distance, owner = first_hits(scene, o, d)
    hit = np.flatnonzero(owner >= 0)
    return o[hit] + distance[hit, None] * d[hit], owner[hit], distance[hit]


def observe(scene: Scene, cameras: Sequence[Camera], points: Array, owner: Array) -> tuple[Array, Array]:
    """In how many views surface points are visible, and their mean colour there.

    Args:
        scene: solids and light.
        cameras: the views.
        points: on the surfaces, ``[M, 3]`` float32.
        owner: index of each point's body ``[M]``.

    Returns:
        Number of views ``[M]`` and mean RGB ``[M, 3]`` (0 where no view sees the point).
    """
    views = np.zeros(len(points), np.int64)
    total = np.zeros((len(points), 3), np.float32)
    for camera in cameras:
        seen = np.flatnonzero(in_frame(camera, *project(camera, points)))
        rays = points[seen] - camera.position.astype(points.dtype)
        length = np.linalg.norm(rays, axis=1)
        rays /= length[:, None]
        reach, _ = first_hits(scene, np.broadcast_to(camera.position, rays.shape).astype(points.dtype), rays)
        # The surface itself is hit at `length`, to within rounding; anything clearly nearer hides it.
        clear = reach > length * (1 - 1e-3) - 1e-3
        seen, rays = seen[clear], rays[clear]
        views[seen] += 1
        total[seen] += shade(scene, points[seen], rays, owner[seen])
    return views, total / np.maximum(views, 1)[:, None]


def sparse_points(
    scene: Scene,
    cameras: Sequence[Camera],
    pictures: Sequence[Array],
    count: int,
    *,
    noise: float,
    outliers: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Draw a point cloud: surface points that two views or more share, more of them where the pictures have detail.

    Args:
        scene: solids and light.
        cameras: training views.
        pictures: what they show, each ``[H, W, 3]`` in [0, 1].
        count: points to return.
        noise: standard deviation of the error of a position, as a fraction of its distance from the camera.
        outliers: fraction of the points that are wrong matches, anywhere around the scene.
        rng: source of randomness.

    Returns:
        Positions ``[count, 3]`` float32, and RGB ``[count, 3]`` uint8.
    """
    wrong = round(count * outliers)
    wanted = count - wrong
    found, colors, have = [], [], 0
    while have < wanted:
        points, owner, distance = _surface_points(scene, cameras, pictures, max(2 * (wanted - have), 64), rng)
        views, color = observe(scene, cameras, points, owner)
        good = views >= MIN_VIEWS
        jitter = rng.normal(size=points.shape) * (noise * distance)[:, None]
        found.append((points + jitter)[good])
        colors.append(color[good])
        have += int(good.sum())
    # The pixels came camera by camera: shuffle before cutting, or the last cameras would lose theirs.
    order = rng.permutation(have)[:wanted]
    xyz, rgb = np.concatenate(found)[order], np.concatenate(colors)[order]
    stray = rng.uniform([-3, -3, -0.5], [3, 3, 2.5], size=(wrong, 3))
    stray_rgb = rng.uniform(size=(wrong, 3))
    xyz, rgb = np.concatenate([xyz, stray]), np.concatenate([rgb, stray_rgb])
    rgb = rgb + rng.normal(scale=0.01, size=rgb.shape)
    return xyz.astype(np.float32), np.round(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
