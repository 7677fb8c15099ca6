"""The ray tracer: first hits, lighting (Lambert and Blinn-Phong with hard shadows) and supersampled images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ray_tracing.cameras import Camera, pixel_rays
from ray_tracing.shapes import EPSILON, Array, Shape
from ray_tracing.textures import Texture

RAYS_PER_BLOCK = 1 << 15
"""Rays traced at once: few enough for the intermediate arrays to stay in a core's cache."""


@dataclass(frozen=True)
class Body:
    """A solid in the scene: shape, texture, pose and material."""

    shape: Shape
    texture: Texture
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: Array = field(default_factory=lambda: np.eye(3))
    """Local to world, ``[3, 3]``."""
    specular: float = 0.0
    """Strength of the highlight."""
    shininess: float = 32.0
    """Blinn-Phong exponent; a larger one makes the highlight smaller."""
    luminous: bool = False
    """Show the texture unshaded, and cast no shadow."""


@dataclass(frozen=True)
class TracedScene:
    """Solids and one distant light."""

    bodies: tuple[Body, ...]
    light: Array
    """Unit vector towards the light, ``[3]``."""
    ambient: float = 0.42
    diffuse: float = 0.68


def _to_local(body: Body, points: Array) -> Array:
    return (points - np.asarray(body.position, points.dtype)) @ body.rotation.astype(points.dtype)


def _distances(body: Body, origins: Array, directions: Array) -> Array:
    """Distance ``[M]`` to one solid; only rays that meet its bounding sphere are intersected."""
    result = np.full(len(origins), np.inf, origins.dtype)
    local = _to_local(body, origins)
    heading = directions @ body.rotation.astype(directions.dtype)
    along = np.einsum("mi,mi->m", local, heading)
    from_centre = np.einsum("mi,mi->m", local, local)
    bound = body.shape.bound**2 * 1.001
    near = np.flatnonzero((from_centre - along**2 <= bound) & ((along < 0) | (from_centre <= bound)))
    result[near] = body.shape.intersect(local[near], heading[near])
    return result


def first_hits(scene: TracedScene, origins: Array, directions: Array) -> tuple[Array, Array]:
    """Nearest surfaces along rays with origins ``[M, 3]`` and unit directions ``[M, 3]``.

    Returns:
        Distances ``[M]`` (``inf`` for a miss) and the index of the body hit ``[M]`` (-1 for a miss).
    """
    best = np.full(len(origins), np.inf, origins.dtype)
    owner = np.full(len(origins), -1)
    for index, body in enumerate(scene.bodies):
        distance = _distances(body, origins, directions)
        closer = distance < best
        best[closer], owner[closer] = distance[closer], index
    return best, owner


def _in_shadow(scene: TracedScene, points: Array) -> Array:
    """True ``[M]`` where a solid lies between the point and the light."""
    towards = np.broadcast_to(scene.light.astype(points.dtype), points.shape)
    dark = np.zeros(len(points), bool)
    for body in scene.bodies:
        if not body.luminous:
            dark |= np.isfinite(_distances(body, points, towards))
    return dark


def shade(scene: TracedScene, points: Array, directions: Array, owner: Array) -> Array:
    """Colours of surface points, seen along given directions.

    Args:
        points: on the surfaces, ``[M, 3]``.
        directions: unit vectors from the eye to the points, ``[M, 3]``.
        owner: index of each point's body ``[M]``; -1 is black.

    Returns:
        RGB ``[M, 3]`` in [0, 1], float32.
    """
    colors = np.zeros((len(points), 3), np.float32)
    for index, body in enumerate(scene.bodies):
        mine = np.flatnonzero(owner == index)
        if len(mine) == 0:
            continue
        local = _to_local(body, points[mine])
        albedo = body.texture(local)
        if body.luminous:
            colors[mine] = albedo
            continue
        normals = body.shape.normal(local) @ body.rotation.T.astype(local.dtype)
        facing = normals @ scene.light.astype(normals.dtype)
        halfway = scene.light - directions[mine]
        halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
        highlight = body.specular * np.maximum((normals * halfway).sum(axis=1), 0) ** body.shininess
        lit = facing > 0
        # Start off the surface by more than the rounding error, or a solid would shadow itself in spots.
        lit[lit] = ~_in_shadow(scene, points[mine[lit]] + 10 * EPSILON * normals[lit])
        # Ambient light from the sky: a surface that faces down gets half of the amount of one that faces up.
        sky = scene.ambient * (0.75 + 0.25 * normals[:, 2])
        colors[mine] = albedo * (sky + scene.diffuse * facing * lit)[:, None] + (highlight * lit)[:, None]
    return np.clip(colors, 0, 1)


def render(scene: TracedScene, camera: Camera, *, samples: int = 2) -> Array:
    """Image of a scene with ``samples`` x ``samples`` rays per pixel: ``[H, W, 3]`` float32 in [0, 1]."""
    columns = (np.arange(camera.width * samples) + 0.5) / samples
    rows_per_block = max(1, RAYS_PER_BLOCK // (len(columns) * samples))
    image = np.empty((camera.height, camera.width, 3), np.float32)
    for top in range(0, camera.height, rows_per_block):
        bottom = min(top + rows_per_block, camera.height)
        rows = (np.arange(top * samples, bottom * samples) + 0.5) / samples
        x, y = np.meshgrid(columns, rows)
        origins, directions = pixel_rays(camera, x.ravel(), y.ravel())
        distance, owner = first_hits(scene, origins, directions)
        reach = np.where(owner >= 0, distance, 0)[:, None]
        colors = shade(scene, origins + reach * directions, directions, owner)
        block = colors.reshape(bottom - top, samples, camera.width, samples, 3)
        image[top:bottom] = block.mean(axis=(1, 3))
    return image
