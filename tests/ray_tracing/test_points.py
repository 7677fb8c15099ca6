import numpy as np
from ray_tracing.cameras import in_frame, orbit, project
from ray_tracing.points import sparse_points
from ray_tracing.still_life import still_life
from ray_tracing.tracer import first_hits, render


def test_every_point_is_seen_by_two_cameras():
    scene = still_life(2)
    cameras = orbit(5, width=48, height=48, rng=np.random.default_rng(0))
    images = [render(scene, camera, samples=1) for camera in cameras]
    rng = np.random.default_rng(1)
    points, _ = sparse_points(scene, cameras, images, 300, noise=0.0, outliers=0.0, rng=rng)
    views = np.zeros(len(points), int)
    for camera in cameras:
        rays = points.astype(np.float64) - camera.position
        length = np.linalg.norm(rays, axis=1)
        reach, _ = first_hits(scene, np.broadcast_to(camera.position, rays.shape), rays / length[:, None])
        views += in_frame(camera, *project(camera, points)) & (reach > 0.99 * length)
    assert (views >= 2).all()


def test_points_are_denser_where_the_images_have_detail():
    scene = still_life(0)
    cameras = orbit(12, width=64, height=64, rng=np.random.default_rng(0))
    images = [render(scene, camera) for camera in cameras]

    def background_fraction(images):
        rng = np.random.default_rng(1)
        points, _ = sparse_points(scene, cameras, images, 600, noise=0.0, outliers=0.0, rng=rng)
        return (np.linalg.norm(points, axis=1) > 15).mean()

    # Black images have no detail: points spread evenly over them, also over the smooth landscape.
    assert background_fraction(images) < 0.6 * background_fraction([0 * image for image in images])
