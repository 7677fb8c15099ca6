"""Films: closed, smooth paths through a scene's views, or virtual ones."""

import dataclasses
import math

import pytest
import torch

import sundae_ns as sn
from sundae_ns.core.errors import ConfigError
from sundae_ns.scene.cameras import MOST_FRAMES, film_views

COUNT = 120


def ball(n=4000):
    """A solid one of radius 1."""
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1)
    points = points * torch.rand(n, 1, generator=generator) ** (1 / 3)
    scene = sn.Scene.from_points(points, torch.rand(n, 3, generator=generator))
    scene.gaussians["opacities"][:] += 4
    return scene


def looking(eyes, targets=None, up=(0.0, 0.0, 1.0)):
    """Cameras at eyes that look at targets, by default at the middle of the ball."""
    pairs = zip(eyes, targets or len(eyes) * [(0.0, 0.0, 0.0)], strict=True)
    return tuple(sn.Camera.look_at(eye, target, up, fov=50, width=40, height=30) for eye, target in pairs)


def on_a_ring(n):
    """In no order, some higher than others."""
    turns = [2 * math.pi * (7 * i % n) / n for i in range(n)]
    return [(4 * math.cos(turn), 4 * math.sin(turn), 0.5 * math.cos(3 * turn)) for turn in turns]


def film(scene, **values):
    return film_views(dataclasses.replace(scene, **values), seconds=COUNT / 24, frames_per_second=24)


def steps(cameras, distance):
    """Motion and turning from each frame to the next, and from the last to the first ``[V]``."""
    parts = torch.stack([torch.cat([camera.center / distance, -camera.pose[:, 2]]) for camera in cameras]).double()
    return (parts.roll(-1, dims=0) - parts).norm(dim=1)


def check_upright(cameras, up=(0.0, 0.0, 1.0)):
    up = torch.tensor(up)
    for camera in cameras:
        assert abs(float(camera.pose[:, 0] @ up)) < 1e-5
        assert float(camera.pose[:, 1] @ up) > 0.3


def test_the_path_leads_through_views_and_closes():
    eyes = on_a_ring(23)
    stored = looking(eyes)
    cameras = film(ball(), cameras=stored)
    assert len(cameras) == COUNT
    assert (cameras[0].width, cameras[0].height) == (40, 30)
    assert torch.equal(cameras[0].K, stored[0].K)
    assert torch.allclose(cameras[0].viewmat, stored[0].viewmat, atol=1e-5)
    found = steps(cameras, 3.0)  # the ball's near side is 3 away
    assert float(found.max() / found.min()) < 1.2
    check_upright(cameras)
    centers = torch.stack([camera.center for camera in cameras])
    angles = torch.atan2(centers[:, 1], centers[:, 0])
    turns = (angles.roll(-1) - angles + math.pi).remainder(2 * math.pi) - math.pi
    assert abs(float(turns.sum())) == pytest.approx(2 * math.pi, rel=1e-5), "once around, not to and fro"
    assert int((torch.cdist(torch.tensor(eyes), centers).amin(dim=1) < 0.1).sum()) >= 6
    assert float(centers.norm(dim=1).min()) > 3.5, "the spline cuts no corner"


def test_it_begins_with_the_start_view_and_keeps_the_up_axis():
    up = (math.sin(0.3), 0.0, math.cos(0.3))
    start = sn.Camera.look_at((0, -5, 1), (0, 0, 0), fov=30, width=3000, height=2000)
    cameras = film(ball(), cameras=looking(on_a_ring(9), up=up), start=start, up=up)
    assert torch.allclose(cameras[0].center, start.center, atol=1e-4)
    assert (cameras[0].width, cameras[0].height) == (1280, 853)
    assert cameras[0].focal == pytest.approx(start.focal * 1280 / 3000, rel=1e-3)
    check_upright(cameras, up)


def test_views_in_opposite_directions_are_turned_between_and_one_straight_down_is_passed_over():
    eyes = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.2, 0.0, 0.0)]
    cameras = film(ball(), cameras=looking(eyes, [(0.0, 9.0, 0.0), (0.1, -9.0, 0.0), (0.2, 9.0, 0.0)]))
    found = steps(cameras, 1.0)
    assert float(found.max()) < 3 * float(found.mean())
    check_upright(cameras)
    tilted = looking(eyes, [(9.0, 0.0, 18.0), (9.1, 0.0, -18.0), (0.2, 9.0, 0.0)])  # up and down at one azimuth
    check_upright(film(ball(), cameras=tilted, up=(0.0, 0.0, 1.0)))
    found = film(ball(), cameras=looking([(0.0, 0.0, 6.0), *on_a_ring(5)]), up=(0.0, 0.0, 1.0))
    check_upright(found)
    assert max(float(camera.center[2]) for camera in found) < 2


@pytest.mark.parametrize(("stored", "factor"), [(0, 1.0), (1, 1000.0), (4, 1.0)])
def test_a_film_of_a_scene_without_a_path_looks_at_its_middle(stored, factor):
    scene, up = sn.transform(ball(1500), scale=factor), (0.0, -1.0, 0.0)
    cameras = film(scene, cameras=stored * looking([(0.0, -5.0 * factor, 0.0)]), up=up)
    found = steps(cameras, float(cameras[0].center.norm()))
    assert float(found.max() / found.min()) < 2
    check_upright(cameras, up)
    to_eye = [torch.nn.functional.normalize(camera.center, dim=0) for camera in cameras]
    assert min(float(eye @ camera.pose[:, 2]) for eye, camera in zip(to_eye, cameras, strict=True)) > 0.9
    assert min([float(sn.render(scene, camera.zoomed(0.05)).accumulation.mean()) for camera in cameras[::20]]) > 0.1
    assert (cameras[0].width, cameras[0].height) == ((40, 30) if stored else (1280, 720))


@pytest.mark.parametrize(("seconds", "speed"), [(0, 24), (-1, -24), (0.01, 24), (math.nan, 24), (9, MOST_FRAMES)])
def test_impossible_lengths_are_refused(seconds, speed):
    with pytest.raises(ConfigError, match="is impossible"):
        film_views(ball(), seconds=seconds, frames_per_second=speed)
