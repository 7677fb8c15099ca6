"""What counts as a floater in front of a camera."""

import pytest
import torch
from fields import normal_field
from torch.nn import Parameter

from sundae_ns.core.gaussians import Gaussians
from sundae_ns.pruning.decision import Pruner
from sundae_ns.pruning.floaters import floater_odds, near_cameras


def scene():
    """Eight cameras on a circle of radius 4, and 2,000 points in a ball of radius 1: at least 3 from each of them."""
    angle = torch.arange(8) * torch.pi / 4
    eyes = torch.stack([4 * angle.cos(), 4 * angle.sin(), 0 * angle], dim=1)
    points = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    return eyes, points


def test_a_primitive_is_a_floater_where_the_points_say_that_nothing_is():
    eyes, points = scene()
    nearest = torch.cdist(points, eyes).amin(dim=1).sort().values[19]  # a hundredth of them is nearer
    towards = torch.tensor([-1.0, 0, 0])
    means = eyes[0] + towards * nearest * torch.tensor([[0.1], [0.6666], [0.6667], [1.0], [4.0]])
    assert near_cameras(means, eyes, points).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize(("scale", "shift"), [(1e-3, 0), (1e6, 0), (1, 2**12)])
def test_unit_and_origin_do_not_matter(scale, shift):
    eyes, points = scene()
    means = 3 * torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) + 1
    means[0], points[:3] = eyes[0] - torch.tensor([[1.8, 0, 0], [2.5, 0, 0]])
    eyes, points, means = ((value * 2**10).round() / 2**10 for value in (eyes, points, means))  # float32 moves them
    found = near_cameras(means, eyes, points)
    assert not found[0], "three points show it"
    assert 0 < found.sum() < 500
    assert torch.equal(near_cameras(*(scale * value + shift for value in (means, eyes, points))), found)


def test_a_few_wrong_points_do_not_hide_floaters_and_nan_does_not_count():
    eyes, points = scene()
    means = eyes[:1] - torch.tensor([[1.0, 0, 0]])
    points[:8] = eyes + 1e-3  # matched wrongly, in front of each lens
    points[10:500, 1] = torch.nan
    assert near_cameras(means, eyes, points).all()


def test_what_sparse_points_show_near_a_camera_is_no_floater():
    """A few photos of a flower beside the path: so few of the points that they do not say how near the scene comes."""
    eyes, points = scene()
    means = eyes[0] - torch.tensor([[0.5, 0, 0], [0.5, 0.05, 0], [0.5, 0.0, 1.2]])
    for shown, floats in ((2, [True, True, True]), (3, [False, False, True])):
        points[:shown] = means[0] + 0.1 * torch.randn(shown, 3, generator=torch.Generator().manual_seed(0))
        assert near_cameras(means, eyes, points).tolist() == floats


def test_without_points_or_cameras_nothing_floats():
    eyes, points = scene()
    for one, other in ((eyes[:0], points), (eyes, points[:0]), (eyes, points * torch.nan)):
        assert not near_cameras(eyes, one, other).any()
    assert near_cameras(points[:0], eyes, points).shape == (0,)


@pytest.mark.parametrize(("rows", "removed"), [(0, 0), (5, 5), (6, 0)])
def test_more_floaters_than_there_can_be_stay(rows, removed):
    params = {"means": Parameter(torch.arange(300.0).reshape(100, 3))}
    assert Pruner(params, {}).drop(torch.arange(100) < rows, at_most=0.05) == removed
    assert params["means"][:, 0].tolist() == [3 * row for row in range(removed, 100)]


def test_odds_of_a_known_field_stay_as_they_are():
    """All weights come from one fit: who changes one of them measures again what cleaning removes of seven fields."""
    field, row = Gaussians(normal_field(400, degree=0)), torch.arange(400)[:, None]
    field["means"].tanh_()
    planted, varied = row < 18, (row >= 18) & (field["means"][:, :1] > 0.5)
    field["means"][:, 1:2] *= torch.where(planted, 0.4, 0.02)
    field["features_dc"] *= torch.where(planted | varied, 1.5, 0.2)
    field["scales"][:] = 0.2 * field["scales"] - 3.5 + (1.4 + 1.2 * field["quats"][:, :1]) * planted
    field["scales"][:, :1] -= 6 * varied  # flat
    field["scales"][:6, 1:] -= 5  # needles
    field["scales"][:6, 0] = -0.6
    field["scales"][6:9] = torch.tensor([[-0.4], [-5.5], [-5.5]])  # large, tiny
    odds = floater_odds(field)
    odds = odds[odds.isfinite()]
    assert (len(odds), float(odds.sum())) == (11, pytest.approx(35.8581128, rel=1e-5))
