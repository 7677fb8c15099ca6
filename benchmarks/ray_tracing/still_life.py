"""A still life of fine and smooth solids on a tiled plinth, before a far landscape."""

from __future__ import annotations

import numpy as np

from ray_tracing.shapes import Array, Box, Cylinder, Sphere, Torus
from ray_tracing.textures import Checker, Gradient, Landscape, Marble, Speckle, Spiral, Tiles, Wood
from ray_tracing.tracer import Body, TracedScene

PLINTH_RADIUS = 2.1
DOME_RADIUS = 24.0


def _yaw(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _pitch(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def still_life(seed: int = 0) -> TracedScene:
    """Build the scene; the seed varies places and rotations of the solids, every random texture, and the light."""
    rng = np.random.default_rng([seed, 1])
    salt = int(rng.integers(1 << 20))
    turn = rng.uniform(0, 2 * np.pi)

    def spot(radius: float, angle: float, height: float) -> tuple[float, float, float]:
        a = np.radians(angle + rng.uniform(-6, 6)) + turn
        return (radius * float(np.cos(a)), radius * float(np.sin(a)), height)

    bodies = (
        Body(Sphere(DOME_RADIUS), Landscape(salt), luminous=True),
        Body(
            Cylinder(PLINTH_RADIUS, 0.12),
            Tiles(
                plain=(0.80, 0.76, 0.70),
                grout=(0.42, 0.38, 0.35),
                mosaic=((0.16, 0.34, 0.52), (0.86, 0.80, 0.66), (0.72, 0.34, 0.22), (0.22, 0.52, 0.50)),
                inner=1.3,
                outer=1.86,
                seed=salt + 1,
            ),
            position=(0.0, 0.0, -0.12),
        ),
        Body(
            Sphere(0.52),
            Marble((0.93, 0.91, 0.88), (0.20, 0.22, 0.32), 2.2, salt + 2),
            position=(0.0, 0.0, 0.52),
            rotation=_yaw(rng.uniform(0, 6)) @ _pitch(0.5),
            specular=0.35,
            shininess=60.0,
        ),
        Body(
            Sphere(0.36),
            Gradient((0.62, 0.06, 0.08), (0.92, 0.26, 0.16), 0.36),
            position=spot(0.98, 0, 0.36),
            specular=0.55,
            shininess=40.0,
        ),
        Body(
            Box((0.28, 0.28, 0.42)),
            Checker((0.10, 0.12, 0.16), (0.95, 0.78, 0.25), 0.105, salt + 3),
            position=spot(1.0, 62, 0.42),
            rotation=_yaw(rng.uniform(0, 6)),
            specular=0.1,
        ),
        Body(
            Torus(0.30, 0.13),
            Speckle((0.15, 0.45, 0.42), ((0.95, 0.92, 0.80), (0.90, 0.55, 0.20), (0.05, 0.12, 0.20)), 26.0, salt + 4),
            position=spot(1.0, 124, 0.13),
            specular=0.3,
        ),
        Body(
            Cylinder(0.22, 0.55),
            Spiral(((0.92, 0.90, 0.86), (0.16, 0.28, 0.62), (0.92, 0.90, 0.86), (0.75, 0.18, 0.24)), 3.0),
            position=spot(1.0, 180, 0.55),
            specular=0.2,
        ),
        Body(
            Box((0.38, 0.26, 0.20)),
            Wood((0.82, 0.60, 0.36), (0.42, 0.24, 0.12), 9.0, salt + 5),
            position=spot(1.0, 240, 0.20),
            rotation=_yaw(rng.uniform(0, 6)),
        ),
        Body(
            Sphere(0.24),
            Gradient((0.12, 0.30, 0.16), (0.50, 0.72, 0.30), 0.24),
            position=spot(0.95, 300, 0.24),
            specular=0.45,
            shininess=24.0,
        ),
    )
    sun = np.radians(rng.uniform(0, 360))
    light = np.array([0.55 * np.cos(sun), 0.55 * np.sin(sun), 0.83])
    return TracedScene(bodies, light / np.linalg.norm(light))
