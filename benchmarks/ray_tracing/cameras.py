"""Pinhole cameras in nerfstudio's convention, on an orbit around a scene.

World: z up. Camera: OpenGL axes (x right, y up, looking along -z). Pixels: x right, y down, centres at +0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ray_tracing.shapes import Array

FIELD_OF_VIEW = 50.0
"""Degrees, across the shorter side of the image."""
GOLDEN = (5**0.5 - 1) / 2
"""Golden ratio minus 1: any number of its multiples, modulo 1, fills [0, 1) evenly."""


@dataclass(frozen=True)
class Camera:
    """One view: ``camera_to_world`` ``[4, 4]`` float64, ``focal`` in pixels, principal point centred."""

    camera_to_world: Array
    focal: float
    width: int
    height: int

    @property
    def position(self) -> Array:
        """Centre of projection ``[3]``, world units."""
        return self.camera_to_world[:3, 3]


def look_at(eye: Array, target: Array) -> Array:
    """Camera-to-world matrix ``[4, 4]`` of a camera at ``eye`` ``[3]`` that faces ``target`` ``[3]``, without roll."""
    back = eye - target
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return matrix


def orbit(count: int, *, width: int, height: int, rng: np.random.Generator) -> list[Camera]:
    """``count`` cameras on one orbit around the scene, at varying heights and distances.

    The azimuth grows steadily; the elevation follows the golden-ratio sequence. Neighbours in the list are neighbours
    around the scene, and a few consecutive cameras cover low, middle and high views.

    Args:
        width, height: pixels.
    """
    focal = float(0.5 * min(width, height) / np.tan(np.radians(FIELD_OF_VIEW) / 2))
    cameras = []
    for i in range(count):
        azimuth = 2 * np.pi * (i + rng.uniform(-0.2, 0.2)) / count
        elevation = np.radians(12 + 36 * ((i * GOLDEN) % 1.0))
        distance = 4.0 + rng.uniform(-0.4, 0.4)
        around = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
        eye = distance * np.array([*around, np.sin(elevation)]) + [0, 0, 0.3]
        target = np.array([0, 0, 0.35]) + rng.uniform(-0.12, 0.12, 3)
        cameras.append(Camera(look_at(eye, target), focal, width, height))
    return cameras


def pixel_rays(camera: Camera, columns: Array, rows: Array) -> tuple[Array, Array]:
    """Rays through the image points at columns x and rows y, in pixels, each ``[M]``.

    Returns:
        Origins and unit directions in world space, each ``[M, 3]`` float32.
    """
    x = (columns - camera.width / 2) / camera.focal
    y = (rows - camera.height / 2) / camera.focal
    local = np.stack([x, -y, -np.ones_like(x)], axis=-1)
    directions = local @ camera.camera_to_world[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(camera.position, directions.shape)
    return origins.astype(np.float32), directions.astype(np.float32)


def project(camera: Camera, points: Array) -> tuple[Array, Array]:
    """Image points ``[M, 2]`` (x, y in pixels) and depths ``[M]`` (positive in front) of world points ``[M, 3]``."""
    local = (points - camera.position) @ camera.camera_to_world[:3, :3]
    depth = -local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        image = np.stack([local[:, 0], -local[:, 1]], axis=1) / depth[:, None] * camera.focal
    return image + [camera.width / 2, camera.height / 2], depth


def in_frame(camera: Camera, image_points: Array, depth: Array) -> Array:
    """True ``[M]`` for projected points that lie in front of the camera and inside its image."""
    x, y = image_points[:, 0], image_points[:, 1]
    return (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
