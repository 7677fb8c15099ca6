"""The ray tracer: first hits, lighting (Lambert and Blinn-Phong with hard shadows) and supersampled pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sundae_ns.data.cameras import Camera, pixel_rays
from sundae_ns.data.shapes import EPSILON, Array, Shape
from sundae_ns.data.textures import Texture

RAYS_PER_BLOCK = 1 << 15
"""Rays traced at once: few enough that the intermediate arrays stay in a core's cache."""


@dataclass(frozen=True)
class Body:
    """A solid in the scene: shape, texture, place, and how it answers to light."""

    shape: Shape
    texture: Texture
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: Array = field(default_factory=lambda: np.eye(3))
    """Local to world, ``[3, 3]``."""
    specular: float = 0.0
    """Strength of the highlight."""
    shininess: float = 32.0
    """Blinn-Phong exponent: the larger, the smaller the highlight."""
    luminous: bool = False
    """Shows its texture as it is: neither shaded nor casting a shadow."""


@dataclass(frozen=True)
class Scene:
    """Solids and one distant light."""

    bodies: tuple[Body, ...]
    light: Array
    """Unit vector towards the light, ``[3]``."""
    ambient: float = 0.42
    diffuse: float = 0.68


def _to_local(body: Body, points: Array) -> Array:
    return (points - np.asarray(body.position, points.dtype)) @ body.rotation.astype(points.dtype)


def _distances(body: Body, origins: Array, directions: Array) -> Array:
    """Distance ``[M]`` to one solid; only rays that meet its bounding sphere are put to the shape."""
    result = np.full(len(origins), np.inf, origins.dtype)
    local = _to_local(body, origins)
    heading = directions @ body.rotation.astype(directions.dtype)
    along = np.einsum("mi,mi->m", local, heading)
    from_centre = np.einsum("mi,mi->m", local, local)
    bound = body.shape.bound**2 * 1.001
    near = np.flatnonzero((from_centre - along**2 <= bound) & ((along < 0) | (from_centre <= bound)))
    result[near] = body.shape.intersect(local[near], heading[near])
    return result


def first_hits(scene: Scene, origins: Array, directions: Array) -> tuple[Array, Array]:
    """Nearest surfaces along rays.

    Args:
        scene: the solids.
        origins: ``[M, 3]``.
        directions: unit vectors ``[M, 3]``.

    Returns:
        Distances ``[M]`` (``inf``: nothing there) and the index of the body hit ``[M]`` (-1: nothing).
    """
    best = np.full(len(origins), np.inf, origins.dtype)
    owner = np.full(len(origins), -1)
    for index, body in enumerate(scene.bodies):
        distance = _distances(body, origins, directions)
        closer = distance < best
        best[closer], owner[closer] = distance[closer], index
    return best, owner


def _in_shadow(scene: Scene, points: Array) -> Array:
    """True ``[M]`` where a solid stands between the point and the light."""
    towards = np.broadcast_to(scene.light.astype(points.dtype), points.shape)
    dark = np.zeros(len(points), bool)
    for body in scene.bodies:
        if not body.luminous:
            dark |= np.isfinite(_distances(body, points, towards))
    return dark


def shade(scene: Scene, points: Array, directions: Array, owner: Array) -> Array:
    """Colours of surface points as seen along given directions.

    Args:
        scene: solids and light.
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
        # Off the surface by more than its own rounding error, or a solid would shadow itself in spots.
        lit[lit] = ~_in_shadow(scene, points[mine[lit]] + 10 * EPSILON * normals[lit])
        # Light from the sky: half of it is lost by a surface that looks down.
        sky = scene.ambient * (0.75 + 0.25 * normals[:, 2])
        colors[mine] = albedo * (sky + scene.diffuse * facing * lit)[:, None] + (highlight * lit)[:, None]
    return np.clip(colors, 0, 1)


def render(scene: Scene, camera: Camera, *, samples: int = 2) -> Array:
    """Picture of a scene, antialiased by ``samples`` x ``samples`` rays a pixel: ``[H, W, 3]`` float32 in [0, 1]."""
    columns = (np.arange(camera.width * samples) + 0.5) / samples
    rows_per_block = max(1, RAYS_PER_BLOCK // (len(columns) * samples))
    picture = np.empty((camera.height, camera.width, 3), np.float32)
    for top in range(0, camera.height, rows_per_block):
        bottom = min(top + rows_per_block, camera.height)
        rows = (np.arange(top * samples, bottom * samples) + 0.5) / samples
        x, y = np.meshgrid(columns, rows)
        origins, directions = pixel_rays(camera, x.ravel(), y.ravel())
        distance, owner = first_hits(scene, origins, directions)
        reach = np.where(owner >= 0, distance, 0)[:, None]
        colors = shade(scene, origins + reach * directions, directions, owner)
        block = colors.reshape(bottom - top, samples, camera.width, samples, 3)
        picture[top:bottom] = block.mean(axis=(1, 3))
    return picture
