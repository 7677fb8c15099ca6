"""A scene that needs few primitives: one flat painted wall without a highlight, which fills every image."""

from __future__ import annotations

import numpy as np

from sundae_ns.data.shapes import Box
from sundae_ns.data.textures import Plaster
from sundae_ns.data.tracer import Body, TracedScene


def wall(seed: int = 0) -> TracedScene:
    """Build the scene: the plane y = 0, for cameras at y < 0; the seed varies paint and light."""
    rng = np.random.default_rng([seed, 4])
    paint = Plaster((0.42, 0.50, 0.58), (0.88, 0.78, 0.62), size=2.5, seed=int(rng.integers(1 << 20)))
    body = Body(Box((12.0, 0.5, 12.0)), paint, position=(0.0, 0.5, 0.0))
    light = np.array([rng.uniform(-0.5, 0.5), -1.0, rng.uniform(0.2, 0.6)])
    return TracedScene((body,), light / np.linalg.norm(light))
