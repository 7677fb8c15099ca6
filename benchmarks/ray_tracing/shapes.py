"""Analytic solids centred on the origin: ray intersections and surface normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

EPSILON = 1e-4
"""Hits closer than this, in world units, are on the surface from which the ray starts."""


class Shape(Protocol):
    """Interface of a solid for the tracer."""

    @property
    def bound(self) -> float:
        """Radius of an enclosing sphere around the origin."""

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Distances ``[M]`` along unit directions to the first surface ahead, ``inf`` for a miss; inputs ``[M, 3]``."""

    def normal(self, points: Array) -> Array:
        """Unit outward normals ``[M, 3]`` at surface points ``[M, 3]``."""


def _first_ahead(near: Array, far: Array) -> Array:
    """First positive end of the intervals ``[near, far]`` in which rays are inside a convex solid."""
    first = np.where(near > EPSILON, near, far)
    return np.where((near <= far) & (first > EPSILON), first, np.inf).astype(near.dtype)


def _slab(origins: Array, directions: Array, half: float) -> tuple[Array, Array]:
    """Interval in which rays are between the planes -half and +half of one axis; inputs ``[M]``."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-half - origins) / directions, (half - origins) / directions
    return np.fmin(a, b), np.fmax(a, b)


def _quadric(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Interval in which ``a t^2 + 2 b t + c <= 0`` for a >= 0; (inf, -inf) if it is empty."""
    discriminant: Array = b * b - a * c
    root = np.sqrt(np.maximum(discriminant, 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-b - root) / a, (-b + root) / a
    parallel = a < 1e-12
    near = np.where(parallel, np.where(c <= 0, -np.inf, np.inf), near)
    far = np.where(parallel, -near, far)
    missed = discriminant < 0
    return np.where(missed, np.inf, near).astype(a.dtype), np.where(missed, -np.inf, far).astype(a.dtype)


@dataclass(frozen=True)
class Sphere:
    """A sphere; from inside it serves as a dome."""

    radius: float

    @property
    def bound(self) -> float:
        """The radius."""
        return self.radius

    def intersect(self, origins: Array, directions: Array) -> Array:
        """See :class:`Shape`."""
        b = np.einsum("mi,mi->m", origins, directions)
        c = np.einsum("mi,mi->m", origins, origins) - self.radius**2
        return _first_ahead(*_quadric(np.ones_like(b), b, c))

    def normal(self, points: Array) -> Array:
        """See :class:`Shape`."""
        return points / self.radius


@dataclass(frozen=True)
class Box:
    """An axis-aligned box of half-extents ``half``."""

    half: tuple[float, float, float]

    @property
    def bound(self) -> float:
        """Half the diagonal."""
        return float(np.linalg.norm(self.half))

    def intersect(self, origins: Array, directions: Array) -> Array:
        """See :class:`Shape`."""
        slabs = [_slab(origins[:, i], directions[:, i], self.half[i]) for i in range(3)]
        near = np.maximum.reduce([slab[0] for slab in slabs])
        far = np.minimum.reduce([slab[1] for slab in slabs])
        return _first_ahead(near, far)

    def normal(self, points: Array) -> Array:
        """See :class:`Shape`."""
        face = np.abs(points / np.asarray(self.half, points.dtype)).argmax(axis=1)
        rows = np.arange(len(points))
        normals = np.zeros_like(points)
        normals[rows, face] = np.sign(points[rows, face])
        return normals


@dataclass(frozen=True)
class Cylinder:
    """A capped cylinder around the z axis."""

    radius: float
    half_height: float

    @property
    def bound(self) -> float:
        """Distance from the centre to the rim."""
        return float(np.hypot(self.radius, self.half_height))

    def intersect(self, origins: Array, directions: Array) -> Array:
        """See :class:`Shape`."""
        o, d = origins[:, :2], directions[:, :2]
        a, b = np.einsum("mi,mi->m", d, d), np.einsum("mi,mi->m", o, d)
        side = _quadric(a, b, np.einsum("mi,mi->m", o, o) - self.radius**2)
        caps = _slab(origins[:, 2], directions[:, 2], self.half_height)
        return _first_ahead(np.maximum(side[0], caps[0]), np.minimum(side[1], caps[1]))

    def normal(self, points: Array) -> Array:
        """See :class:`Shape`."""
        radial = np.hypot(points[:, 0], points[:, 1])
        on_cap = np.abs(points[:, 2]) / self.half_height > radial / self.radius
        normals = np.zeros_like(points)
        normals[:, :2] = points[:, :2] / np.maximum(radial, EPSILON)[:, None]
        normals[on_cap] = 0
        normals[on_cap, 2] = np.sign(points[on_cap, 2])
        return normals


@dataclass(frozen=True)
class Torus:
    """A torus around the z axis: a tube of radius ``minor`` around a circle of radius ``major``."""

    major: float
    minor: float
    max_steps: int = 256

    @property
    def bound(self) -> float:
        """The outer radius."""
        return self.major + self.minor

    def distance(self, points: Array) -> Array:
        """Signed distance ``[M]`` to the surface."""
        ring = np.hypot(points[:, 0], points[:, 1]) - self.major
        return np.hypot(ring, points[:, 2]) - self.minor

    def intersect(self, origins: Array, directions: Array) -> Array:
        """See :class:`Shape`. Sphere tracing (Hart 1996): steps as long as the signed distance cannot overshoot."""
        b = np.einsum("mi,mi->m", origins, directions)
        c = np.einsum("mi,mi->m", origins, origins) - self.bound**2
        near, far = _quadric(np.ones_like(b), b, c)
        result = np.full_like(b, np.inf)
        active = np.flatnonzero(far > EPSILON)
        t = np.maximum(near[active], 0)
        for _ in range(self.max_steps):
            if len(active) == 0:
                break
            gap = np.abs(self.distance(origins[active] + t[:, None] * directions[active]))
            arrived = (gap < EPSILON) & (t > EPSILON)
            result[active[arrived]] = t[arrived]
            # A ray that starts on the surface must first leave it.
            t = t + np.maximum(gap, EPSILON)
            remaining = ~arrived & (t < far[active])
            active, t = active[remaining], t[remaining]
        return result

    def normal(self, points: Array) -> Array:
        """See :class:`Shape`."""
        radial = np.maximum(np.hypot(points[:, 0], points[:, 1]), EPSILON)
        centre = np.zeros_like(points)
        centre[:, :2] = points[:, :2] * (self.major / radial)[:, None]
        return (points - centre) / self.minor
