import numpy as np

from sundae_ns.data import first_hits, in_frame, orbit, project, render, sparse_points, still_life


def test_every_point_is_seen_by_two_cameras():
    scene = still_life(2)
    cameras = orbit(5, width=48, height=48, rng=np.random.default_rng(0))
    pictures = [render(scene, camera, samples=1) for camera in cameras]
    rng = np.random.default_rng(1)
    points, _ = sparse_points(scene, cameras, pictures, 300, noise=0.0, outliers=0.0, rng=rng)
    views = np.zeros(len(points), int)
    for camera in cameras:
        rays = points.astype(np.float64) - camera.position
        length = np.linalg.norm(rays, axis=1)
        reach, _ = first_hits(scene, np.broadcast_to(camera.position, rays.shape), rays / length[:, None])
        views += in_frame(camera, *project(camera, points)) & (reach > 0.99 * length)
    assert (views >= 2).all()


def test_points_gather_where_the_pictures_have_detail():
    scene = still_life(0)
    cameras = orbit(12, width=64, height=64, rng=np.random.default_rng(0))
    pictures = [render(scene, camera) for camera in cameras]

    def share_of_background(views):
        rng = np.random.default_rng(1)
        points, _ = sparse_points(scene, cameras, views, 600, noise=0.0, outliers=0.0, rng=rng)
        return (np.linalg.norm(points, axis=1) > 15).mean()

    # Flat pictures have no detail anywhere: points fall evenly on them, and so on the smooth landscape too.
    assert share_of_background(pictures) < 0.6 * share_of_background([0 * picture for picture in pictures])
