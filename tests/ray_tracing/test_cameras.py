import numpy as np
from ray_tracing.cameras import in_frame, look_at, orbit, pixel_rays, project


def _camera():
    return orbit(5, width=40, height=30, rng=np.random.default_rng(0))[3]


def test_look_at_is_an_opengl_camera_without_roll():
    matrix = look_at(np.array([3.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(matrix[:3, 2], [1, 0, 0], atol=1e-12)  # looks along its own -z
    np.testing.assert_allclose(matrix[:3, 1], [0, 0, 1], atol=1e-12)  # y is up
    np.testing.assert_allclose(matrix[:3, 0], [0, 1, 0], atol=1e-12)
    assert np.isclose(np.linalg.det(matrix[:3, :3]), 1)


def test_projection_inverts_rays():
    camera = _camera()
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 40, 200), rng.uniform(0, 30, 200)
    origins, directions = pixel_rays(camera, x, y)
    image, depth = project(camera, origins + rng.uniform(1, 9, (200, 1)) * directions)
    np.testing.assert_allclose(image, np.stack([x, y], axis=1), atol=2e-4)
    assert in_frame(camera, image, depth).all()


def test_behind_is_not_in_frame():
    camera = _camera()
    origins, directions = pixel_rays(camera, np.array([20.0]), np.array([15.0]))
    assert not in_frame(camera, *project(camera, origins - directions)).any()


def test_top_of_the_image_is_up():
    camera = _camera()
    _, directions = pixel_rays(camera, np.array([20.0, 20.0]), np.array([0.5, 29.5]))
    assert directions[0, 2] > directions[1, 2]
