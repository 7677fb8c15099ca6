"""A capture that needs few primitives: one flat painted wall without a highlight, which fills every image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
from PIL import Image
from ray_tracing import capture
from ray_tracing.cameras import GOLDEN, Camera, look_at, orbit
from ray_tracing.shapes import Array, Box
from ray_tracing.textures import mix, value_noise
from ray_tracing.tracer import Body, TracedScene


@dataclass(frozen=True)
class Plaster:
    """Paint: a smooth blend of two tones with features of about ``size`` units."""

    size: float
    seed: int

    def __call__(self, points: Array) -> Array:
        return mix((0.42, 0.50, 0.58), (0.88, 0.78, 0.62), value_noise(points / self.size, self.seed))


def wall(seed: int) -> TracedScene:
    """The plane y = 0, for cameras at y < 0; the seed varies paint and light."""
    rng = np.random.default_rng([seed, 4])
    paint = Plaster(2.5, int(rng.integers(1 << 20)))
    light = np.array([rng.uniform(-0.5, 0.5), -1.0, rng.uniform(0.2, 0.6)])
    body = Body(Box((12.0, 0.5, 12.0)), paint, position=(0.0, 0.5, 0.0))
    return TracedScene((body,), light / np.linalg.norm(light))


def facing(count: int, *, width: int, height: int, rng: np.random.Generator) -> list[Camera]:
    """Cameras that face the wall from up to 40 degrees to the side, spread evenly."""
    focal = orbit(1, width=width, height=height, rng=np.random.default_rng(0))[0].focal
    cameras = []
    for i in range(count):
        across, up = 2 * ((i + 0.5) / count) - 1, 2 * ((i * GOLDEN) % 1.0) - 1
        eye = np.array([2.6 * across, -3.2 + rng.uniform(-0.3, 0.3), 1.4 * up])
        target = np.array([0.3 * across, 0.0, 0.2 * up]) + rng.uniform(-0.1, 0.1, 3) * [1, 0, 1]
        cameras.append(Camera(look_at(eye, target), focal, width, height))
    return cameras


def write_wall(out: Path, **options: int) -> Path:
    """Write the wall in place of the still life; options of :func:`write_still_life`."""
    parts: dict[str, Callable[..., object]] = {"still_life": wall, "orbit": facing}
    with patch.multiple(capture, **parts):
        return capture.write_still_life(out, **options)


def add_noise(folder: Path, deviation: float) -> None:
    """Add the noise of a sensor to all images, in [0, 1]."""
    rng = np.random.default_rng(5)
    for path in sorted((folder / "images").glob("*.png")):
        image = np.asarray(Image.open(path)) / 255
        image = np.clip(image + rng.normal(scale=deviation, size=image.shape), 0, 1)
        Image.fromarray(np.round(image * 255).astype(np.uint8)).save(path)
