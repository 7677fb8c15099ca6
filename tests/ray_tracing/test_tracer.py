import numpy as np
from ray_tracing.shapes import Box, Sphere
from ray_tracing.tracer import Body, TracedScene, first_hits, shade

UP = np.array([0.0, 0.0, 1.0])


def _plain(points):
    return np.full((len(points), 3), 0.5, np.float32)


def _scene(*bodies):
    return TracedScene(bodies, UP, ambient=0.2, diffuse=0.6)


def test_nearest_body_is_hit_in_any_order():
    near, far = Body(Sphere(0.5), _plain, position=(0, 0, 2)), Body(Sphere(0.5), _plain)
    origin, direction = np.array([[0.0, 0.0, 5.0]]), -UP[None]
    for bodies, index in (((near, far), 0), ((far, near), 1)):
        t, owner = first_hits(_scene(*bodies), origin, direction)
        assert owner.tolist() == [index]
        np.testing.assert_allclose(t, 2.5)


def test_rotated_box_is_hit_at_its_edge():
    c = np.sqrt(0.5)
    body = Body(Box((1.0, 1.0, 1.0)), _plain, rotation=np.array([[c, -c, 0], [c, c, 0], [0, 0, 1]]))
    t, _ = first_hits(_scene(body), np.array([[5.0, 0.01, 0.0]]), np.array([[-1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(t, 5 - np.sqrt(2) + 0.01, atol=1e-6)


def test_shadow_removes_only_the_direct_light():
    floor = Body(Box((3.0, 3.0, 0.1)), _plain)
    scene = _scene(floor, Body(Sphere(0.3), _plain, position=(0, 0, 2)))
    points = np.array([[0.0, 0.0, 0.1], [2.0, 0.0, 0.1]], np.float32)
    dark, lit = shade(scene, points, np.tile(-UP, (2, 1)).astype(np.float32), np.array([0, 0]))
    np.testing.assert_allclose(dark, 0.5 * 0.2, rtol=1e-5)
    np.testing.assert_allclose(lit, 0.5 * (0.2 + 0.6), rtol=1e-5)


def test_highlight_depends_on_the_view():
    scene = _scene(Body(Sphere(1.0), _plain, specular=0.5, shininess=50))
    top = np.array([[0.0, 0.0, 1.0]] * 2, np.float32)
    views = np.array([[0.0, 0.0, -1.0], [0.8, 0.0, -0.6]], np.float32)
    mirrored, aslant = shade(scene, top, views, np.array([0, 0]))
    assert (mirrored > aslant + 0.1).all()
