"""Boxes around scenes, and floaters."""

import dataclasses
import math
import re

import pytest
import torch

import sundae_ns as sn
from sundae_ns.core.errors import ConfigError, DataError
from sundae_ns.scene.compose import crop_mask, floater_mask

VIEWS = tuple(sn.Camera.look_at((x, -4.0, 1.0), (0.0, 0.0, 0.0), fov=60, width=96, height=72) for x in (-2.0, 0.0, 2.0))


def scene_of(points, scale):
    made = dataclasses.replace(sn.Scene.from_points(points, points.sigmoid()), cameras=VIEWS)
    made.gaussians["scales"][:] = math.log(scale)
    made.gaussians["opacities"][:] += 9
    return made


def wall(n=4000):
    """Points of a square of side 4, which faces the views."""
    return (torch.rand(n, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * torch.tensor([4.0, 0.02, 4.0])


def planted(n=30):
    """Points in the air between wall and views, some of them in threes."""
    generator = torch.Generator().manual_seed(1)
    alone = torch.rand(n, 3, generator=generator) * torch.tensor([3.0, 1.5, 3.0]) + torch.tensor([-1.5, -2.5, -1.5])
    return torch.cat([alone, alone[:5] + 0.04, alone[:5] - 0.04])


@pytest.mark.parametrize("factor", [1.0, 1e-3, 1e3])
@pytest.mark.parametrize("with_views", [True, False])
def test_planted_floaters_vanish_and_the_surface_stays(factor, with_views):
    floaters, surface = planted(), wall()
    whole = sn.transform(scene_of(torch.cat([surface, floaters]), 0.02), scale=factor)
    found = floater_mask(whole, whole.cameras if with_views else (), 0.9)
    assert bool(found[len(surface) :].all())
    assert int(found[: len(surface)].sum()) <= 2
    assert 0 < int(floater_mask(whole, (), 0.0).sum()) < len(floaters), "a lower strength removes less"
    if factor == 1:
        clean = sn.remove_floaters(whole, 0.9, cameras=VIEWS if with_views else ())
        assert clean.num_gaussians == int((~found).sum())
        truth = scene_of(surface, 0.02)
        assert sn.measure(clean, truth).psnr > 50
        assert sn.measure(whole, truth).psnr < 35


def test_what_no_view_sees_goes_and_no_image_changes(caplog):
    """A second wall right behind the first, and one behind the cameras; both touch themselves."""
    hidden = torch.cat([wall() * 0.5 + torch.tensor([0.0, 0.9, 0.0]), wall() + torch.tensor([0.0, -9.0, 0.0])])
    whole = scene_of(torch.cat([wall(), hidden]), 0.12)
    floater_mask(whole[:4200], VIEWS, 0.5)
    assert not caplog.messages
    found = floater_mask(whole, VIEWS, 0.5)
    assert re.fullmatch(r"the cameras hardly see \d+% of the Gaussians; if the .*", caplog.messages[0])
    assert float(found[:4000].float().mean()) < 0.05
    assert float(found[4000:8000].float().mean()) > 0.9
    assert bool(found[8000:].all())
    assert sn.measure(sn.remove_floaters(whole), whole).psnr > 70
    assert int(floater_mask(whole, (), 0.5)[4000:].sum()) <= 4, "without views, walls are supported"


def test_floaters_are_counted_after_values_without_meaning():
    whole = scene_of(torch.cat([wall(), planted()]), 0.02)
    whole.gaussians["means"][7] = math.nan
    found = floater_mask(whole, VIEWS, 0.9)
    assert bool(found[7])
    assert int(found[:4000].sum()) <= 3
    assert bool(found[4000:].all())
    away = [sn.Camera.look_at((0.0, -40.0, 0.0), (0.0, -80.0, 0.0), width=32, height=32)]
    with pytest.raises(DataError, match="1 views see none"):
        sn.remove_floaters(whole, cameras=away)
    whole.gaussians["means"][:] = math.nan
    with pytest.raises(DataError, match="no Gaussian is finite"):
        sn.remove_floaters(whole)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_few_primitives(n):
    points = torch.arange(3.0 * n).view(n, 3)
    assert not any(bool(floater_mask(scene_of(points, size), (), 1.0).any()) for size in (0.01, 9.0)), "all are alone"
    with pytest.raises(ConfigError, match="strength of remove-floaters is 2"):
        sn.remove_floaters(scene_of(points, 9.0), 2)


def test_needles_and_balls_unlike_their_neighbours_go_and_a_background_stays():
    whole = scene_of(wall(), 0.02)
    whole.gaussians["features_dc"][:3] = 1.5  # white
    whole.gaussians["scales"][0] = torch.tensor([1.0, 0.002, 0.002]).log()
    whole.gaussians["scales"][1] = math.log(0.3)
    whole.gaussians["scales"][2] = math.log(30.0)
    assert floater_mask(whole, (), 0.9).nonzero()[:, 0].tolist() == [0, 1]


def test_a_box_is_exact_and_keeps_all_else():
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.1, 0.5, 0.5], [1.0, 1.0, 1.0000001], [-1e-30, 0, 0]])
    whole = dataclasses.replace(scene_of(points, 0.1), up=(0.0, 0.0, 1.0), start=VIEWS[1], antialiased=True)
    assert crop_mask(whole, (0, 0, 0), (1, 1, 1)).tolist() == [True, True, True, False, False]
    # 0.1 is not a float32: the box is compared in float64.
    assert crop_mask(whole, (0.1, 0, 0), (2, 2, 2)).tolist()[2] == (float(torch.tensor(0.1).double()) >= 0.1)
    found = sn.crop(whole, (0, 0, 0), (1, 1, 1))
    assert torch.equal(found.gaussians["means"], points[:3])
    assert torch.equal(found.gaussians["scales"], whole.gaussians["scales"][:3])
    assert (found.cameras, found.up, found.start, found.antialiased) == (whole.cameras, whole.up, whole.start, True)
    assert whole.num_gaussians == 5


def test_an_empty_result_says_where_the_scene_is():
    broken = scene_of(wall(), 0.1)
    with pytest.raises(DataError, match=r"90% of them are in -1\.\d+ \S+ \S+ 1\.\d+ "):
        sn.crop(broken, (50, 50, 50), (51, 51, 51))
    with pytest.raises(ConfigError, match="the box is empty"):
        sn.crop(broken, (0, 0, 0), (1, 1, 0))
