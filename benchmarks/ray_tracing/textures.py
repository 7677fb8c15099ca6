"""Procedural textures: colour as a function of a point on a solid, in the solid's own coordinates.

A texture maps points ``[M, 3]`` to RGB ``[M, 3]`` in [0, 1]. Some are smooth and some are fine: a pruning rule should
spend its primitives on the fine ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ray_tracing.shapes import Array

Texture = Callable[[Array], Array]
Color = tuple[float, float, float]


def _scramble(h: np.ndarray) -> np.ndarray:
    """Spread the bits of uint32 values, so that neighbouring lattice cells look independent."""
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = (h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    return h ^ (h >> np.uint32(15))


def _lattice(cell: np.ndarray, axis: int) -> np.ndarray:
    """Integer coordinates of one axis times the constant of this axis (uint32, wraps around)."""
    primes = (73856093, 19349663, 83492791)
    return cell.astype(np.int64).astype(np.uint32) * np.uint32(primes[axis])


def _salt(seed: int) -> np.uint32:
    """Hash of a seed to 32 bits (Knuth's multiplicative hash)."""
    return np.uint32(seed * 2654435761 % 2**32)


def cell_random(cells: np.ndarray, seed: int) -> Array:
    """Random number in [0, 1) of each integer cell ``[M, 3]``: ``[M]`` float32, a function of cell and seed."""
    h = _lattice(cells[:, 0], 0) ^ _lattice(cells[:, 1], 1) ^ _lattice(cells[:, 2], 2)
    return _scramble(h ^ _salt(seed)).astype(np.float32) * np.float32(2**-32)


def value_noise(points: Array, seed: int) -> Array:
    """Smooth noise in [0, 1] ``[M]`` with features of unit size: random values on the lattice, interpolated."""
    base = np.floor(points)
    frac = (points - base).astype(np.float32)
    weight = frac * frac * (3 - 2 * frac)
    salt = _salt(seed)
    keys = [[_lattice(base[:, axis] + corner, axis) for corner in (0, 1)] for axis in range(3)]
    total = np.zeros(len(points), np.float32)
    for i in (0, 1):
        wx = weight[:, 0] if i else 1 - weight[:, 0]
        for j in (0, 1):
            wxy = wx * (weight[:, 1] if j else 1 - weight[:, 1])
            for k in (0, 1):
                value = _scramble(keys[0][i] ^ keys[1][j] ^ keys[2][k] ^ salt).astype(np.float32) * np.float32(2**-32)
                total += wxy * (weight[:, 2] if k else 1 - weight[:, 2]) * value
    return total


def fractal_noise(points: Array, seed: int, octaves: int) -> Array:
    """Sum of octaves of :func:`value_noise`, each twice as fine and half as strong; in [0, 1] ``[M]``."""
    total = np.zeros(len(points), np.float32)
    for octave in range(octaves):
        total += 0.5**octave * value_noise(points * 2**octave, seed + octave)
    return total / (2 - 0.5 ** (octaves - 1))


def mix(a: Color | Array, b: Color | Array, weight: Array) -> Array:
    """Blend two colours, ``[3]`` or ``[M, 3]``, by a weight ``[M]`` clipped to [0, 1]: ``[M, 3]``."""
    w = np.clip(weight, 0, 1).astype(np.float32)[:, None]
    return np.asarray(a, np.float32) * (1 - w) + np.asarray(b, np.float32) * w


def _ramp(x: Array, low: float, high: float) -> Array:
    """0 below ``low``, 1 above ``high``, smooth between."""
    u = np.clip((x - low) / (high - low), 0, 1)
    return u * u * (3 - 2 * u)


@dataclass(frozen=True)
class Gradient:
    """Linear blend of two colours from bottom to top."""

    low: Color
    high: Color
    half_height: float

    def __call__(self, points: Array) -> Array:
        """Colours ``[M, 3]`` of points ``[M, 3]``."""
        return mix(self.low, self.high, 0.5 + 0.5 * points[:, 2] / self.half_height)


@dataclass(frozen=True)
class Checker:
    """A 3D checkerboard of cubes of side ``size``, with a small variation of brightness between cubes."""

    dark: Color
    light: Color
    size: float
    seed: int

    def __call__(self, points: Array) -> Array:
        """Colours ``[M, 3]`` of points ``[M, 3]``."""
        # The shift keeps the faces of a solid away from the cell borders.
        cells = np.floor(points / self.size + 0.37).astype(np.int64)
        tint = 0.85 + 0.15 * cell_random(cells, self.seed)
        return mix(self.dark, self.light, (cells.sum(axis=1) % 2).astype(np.float32)) * tint[:, None]


@dataclass(frozen=True)
class Marble:
    """Veins: stripes across x, distorted by noise."""

    body: Color
    vein: Color
    scale: float
    seed: int

    def __call__(self, points: Array) -> Array:
        """Colours ``[M, 3]`` of points ``[M, 3]``."""
        p = points * self.scale
        phase = p[:, 0] + 0.6 * p[:, 2] + 3.5 * fractal_noise(p + 11.0, self.seed, 3)
        return mix(self.body, self.vein, (0.5 + 0.5 * np.sin(2 * np.pi * phase)) ** 5)


@dataclass(frozen=True)
class Speckle:
    """Fine coloured grains on a plain ground."""

    ground: Color
    grains: Sequence[Color]
    scale: float
    seed: int

    def __call__(self, points: Array) -> Array:
        """Colours ``[M, 3]`` of points ``[M, 3]``."""
        p = points * self.scale
        strength = _ramp(value_noise(p, self.seed), 0.52, 0.66)
        choice = cell_random(np.floor(p * 0.5).astype(np.int64), self.seed + 1)
        grain = np.asarray(self.grains, np.float32)[(choice * len(self.grains)).astype(np.int64)]
        return mix(self.ground, grain, strength)


@dataclass(frozen=True)
class Spiral:
    """Stripes that wind around the z axis ``turns`` times per unit of height."""

    colors: Sequence[Color]
    turns: float

    def __call__(self, points: Array) -> Array:
        """Colours ``[M, 3]`` of points ``[M, 3]``."""
        angle = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
        stripe = (2 * angle + self.turns * points[:, 2]) % 1.0
        return np.asarray(self.colors, np.float32)[(stripe * len(self.colors)).astype(np.int64) % len(self.colors)]


@dataclass(frozen=True)
class Wood:
    """Growth rings around a slanted axis, with fine grain along it."""

    light: Color
    dark: Color
    rings: float
    seed: int

    def __call__(self, points: Array) -> Array:
        """Colours ``[M, 3]`` of points ``[M, 3]``."""
        x, y = points[:, 0] + 0.45, points[:, 1] * 0.9 + 0.2 * points[:, 2] - 0.3
        bend = value_noise(points * 3.0, self.seed)
        ring = (np.hypot(x, y) * self.rings + 0.8 * bend) % 1.0
        grain = value_noise(points * np.asarray([30, 30, 4], points.dtype), self.seed + 1)
        return mix(self.light, self.dark, _ramp(ring, 0.1, 0.9) * 0.75 + 0.3 * (grain - 0.5))


@dataclass(frozen=True)
class Tiles:
    """Floor tiles: a fine mosaic in a ring, large plain tiles inside and outside of it."""

    plain: Color
    grout: Color
    mosaic: Sequence[Color]
    inner: float
    outer: float
    seed: int

    def __call__(self, points: Array) -> Array:
        """Colours ``[M, 3]`` of points ``[M, 3]``."""
        radius = np.hypot(points[:, 0], points[:, 1])
        fine = (radius > self.inner) & (radius < self.outer)
        colors = self._tiled(points, size=0.7, joint=0.03, palette=(self.plain,), variation=0.10)
        colors[fine] = self._tiled(points[fine], size=0.14, joint=0.07, palette=self.mosaic, variation=0.30)
        return colors

    def _tiled(self, points: Array, size: float, joint: float, palette: Sequence[Color], variation: float) -> Array:
        grid = points[:, :2] / size
        cells = np.floor(grid).astype(np.int64)
        cells = np.concatenate([cells, np.zeros_like(cells[:, :1])], axis=1)
        edge = np.abs(grid - np.floor(grid) - 0.5).max(axis=1)
        choice = (cell_random(cells, self.seed) * len(palette)).astype(np.int64)
        tint = 1 - variation * cell_random(cells, self.seed + 1)
        return mix(np.asarray(palette, np.float32)[choice] * tint[:, None], self.grout, _ramp(edge, 0.48 - joint, 0.5))


@dataclass(frozen=True)
class Landscape:
    """The far background: sky with clouds, hills at the horizon, a smooth plain below."""

    seed: int

    def __call__(self, points: Array) -> Array:
        """Colours ``[M, 3]`` of points ``[M, 3]``."""
        direction = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-6)
        height = direction[:, 2]
        sky = mix((0.86, 0.90, 0.94), (0.30, 0.52, 0.82), height / 0.6)
        cloud = fractal_noise(direction * np.asarray([3, 3, 9], points.dtype) + 7.0, self.seed, 3)
        sky = mix(sky, (0.97, 0.97, 0.98), _ramp(cloud, 0.5, 0.75) * _ramp(height, 0.0, 0.2))
        around = direction * np.asarray([4, 4, 0], points.dtype)
        crest = 0.02 + 0.16 * fractal_noise(around + 3.0, self.seed + 9, 3)
        woods = value_noise(direction * 30.0, self.seed + 17)
        hills = mix((0.23, 0.34, 0.30), (0.42, 0.50, 0.38), woods)
        plain = mix((0.55, 0.52, 0.40), (0.36, 0.36, 0.28), -height / 0.7)
        return mix(mix(plain, hills, _ramp(height, -0.12, 0.02)), sky, _ramp(height - crest, -0.006, 0.006))
