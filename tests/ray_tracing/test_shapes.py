"""Shapes against their signed distance: a hit lies on the surface, and the normal is the gradient."""

import numpy as np
import pytest
from ray_tracing.shapes import Box, Cylinder, Sphere, Torus


def _box_distance(shape, p):
    q = np.abs(p) - np.asarray(shape.half)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def _cylinder_distance(shape, p):
    q = np.stack([np.hypot(p[:, 0], p[:, 1]) - shape.radius, np.abs(p[:, 2]) - shape.half_height], axis=1)
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


SHAPES = [
    pytest.param(Sphere(0.7), lambda s, p: np.linalg.norm(p, axis=1) - s.radius, id="sphere"),
    pytest.param(Box((0.3, 0.5, 0.7)), _box_distance, id="box"),
    pytest.param(Cylinder(0.4, 0.6), _cylinder_distance, id="cylinder"),
    pytest.param(Torus(0.6, 0.2), lambda s, p: s.distance(p), id="torus"),
]


def _rays(count=4000):
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(count, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.8, 0.8, size=(count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize(("shape", "distance"), SHAPES)
def test_first_hit(shape, distance):
    origins, directions = _rays()
    t = shape.intersect(origins, directions)
    hit = np.isfinite(t)
    assert 0.2 < hit.mean() < 0.99
    points = origins[hit] + t[hit, None] * directions[hit]
    assert np.abs(distance(shape, points)).max() < 2e-4
    # The solid does not lie before the hit, nor anywhere on a ray that misses.
    reach = np.where(hit, t - 1e-3, 6.0)
    for fraction in np.linspace(0, 1, 97):
        assert distance(shape, origins + (fraction * reach)[:, None] * directions).min() > -2e-4


@pytest.mark.parametrize(("shape", "distance"), SHAPES)
def test_normal_is_gradient_of_distance(shape, distance):
    origins, directions = _rays()
    t = shape.intersect(origins, directions)
    points = (origins + np.where(np.isfinite(t), t, 0)[:, None] * directions)[np.isfinite(t)]
    step = 1e-5
    gradient = np.stack(
        [(distance(shape, points + e) - distance(shape, points - e)) / (2 * step) for e in step * np.eye(3)], axis=1
    )
    # Edges have no normal: compare only where the distance is smooth.
    smooth = np.abs(np.linalg.norm(gradient, axis=1) - 1) < 1e-3
    assert smooth.mean() > 0.9
    agreement = np.einsum("mi,mi->m", gradient, shape.normal(points))[smooth]
    assert np.quantile(agreement, 0.01) > 0.99


@pytest.mark.parametrize(("shape", "distance"), SHAPES)
def test_seen_from_inside(shape, distance):
    inside = np.array([[0.6 if isinstance(shape, Torus) else 0.0, 0.0, 0.0]])
    direction = np.array([[0.36, 0.48, 0.8]])
    t = shape.intersect(inside, direction)
    assert np.isfinite(t).all()
    assert np.abs(distance(shape, inside + t[:, None] * direction)).max() < 2e-4
