"""A sparse point cloud like that of structure from motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ray_tracing.cameras import Camera, in_frame, pixel_rays, project
from ray_tracing.shapes import Array
from ray_tracing.tracer import TracedScene, first_hits, shade

MIN_VIEWS = 2
"""Cameras that must see a point: triangulation takes two rays."""


def _detail(image: Array) -> Array:
    """Weight of a feature at each pixel ``[H, W]``: the gradient of the brightness, plus a small constant."""
    down, right = np.gradient(image.mean(axis=2, dtype=np.float64))
    return np.hypot(down, right) + 0.01


def _surface_points(
    scene: TracedScene, cameras: Sequence[Camera], images: Sequence[Array], count: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Points under ``count`` pixels drawn by detail: positions ``[M, 3]``, owner bodies ``[M]``, distances ``[M]``."""
    origins, directions = [], []
    for camera, image, part in zip(cameras, images, np.array_split(np.arange(count), len(cameras)), strict=True):
        weights = _detail(image).ravel()
        pixels = rng.choice(len(weights), size=len(part), p=weights / weights.sum())
        o, d = pixel_rays(camera, pixels % camera.width + 0.5, pixels // camera.width + 0.5)
        origins.append(o)
        directions.append(d)
    o, d = np.concatenate(origins), np.concatenate(directions)
    distance, owner = first_hits(scene, o, d)
    hit = np.flatnonzero(owner >= 0)
    return o[hit] + distance[hit, None] * d[hit], owner[hit], distance[hit]


def observe(scene: TracedScene, cameras: Sequence[Camera], points: Array, owner: Array) -> tuple[Array, Array]:
    """Count the views that see each surface point, and average its colour over them.

    Args:
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
        # The ray hits the point's own surface at `length`, up to rounding; a clearly nearer hit hides the point.
        clear = reach > length * (1 - 1e-3) - 1e-3
        seen, rays = seen[clear], rays[clear]
        views[seen] += 1
        total[seen] += shade(scene, points[seen], rays, owner[seen])
    return views, total / np.maximum(views, 1)[:, None]


def sparse_points(
    scene: TracedScene,
    cameras: Sequence[Camera],
    images: Sequence[Array],
    count: int,
    *,
    rng: np.random.Generator,
    noise: float = 0.002,
    outliers: float = 0.01,
) -> tuple[Array, Array]:
    """Draw a point cloud: surface points that at least two views see, denser where the images have detail.

    Args:
        images: the image of each view, ``[H, W, 3]`` in [0, 1].
        noise: standard deviation of the error of a position, as a fraction of its distance from the camera.
        outliers: fraction of the points that are wrong matches, placed at random around the scene.

    Returns:
        Positions ``[count, 3]`` float32, and RGB ``[count, 3]`` uint8.
    """
    strays = round(count * outliers)
    inliers = count - strays
    positions, colors, drawn = [], [], 0
    while drawn < inliers:
        points, owner, distance = _surface_points(scene, cameras, images, max(2 * (inliers - drawn), 64), rng)
        views, color = observe(scene, cameras, points, owner)
        good = views >= MIN_VIEWS
        jitter = rng.normal(size=points.shape) * (noise * distance)[:, None]
        positions.append((points + jitter)[good])
        colors.append(color[good])
        drawn += int(good.sum())
    # Points are ordered by camera: shuffle before cutting, or the last cameras lose theirs.
    order = rng.permutation(drawn)[:inliers]
    xyz, rgb = np.concatenate(positions)[order], np.concatenate(colors)[order]
    stray = rng.uniform([-3, -3, -0.5], [3, 3, 2.5], size=(strays, 3))
    stray_rgb = rng.uniform(size=(strays, 3))
    xyz, rgb = np.concatenate([xyz, stray]), np.concatenate([rgb, stray_rgb])
    rgb = rgb + rng.normal(scale=0.01, size=rgb.shape)
    return xyz.astype(np.float32), np.round(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
