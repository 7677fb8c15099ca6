"""Moved fields; survey coordinates; which way is up."""

import pytest
import torch
from fields import assert_moved, normal_field

from sundae_ns.io.coordinates import recentred, rotate_spherical_harmonics, similarity, upward


def rotation(seed=1):
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    return q * q.det()


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_a_similarity_moves_centres_shapes_and_colours(degree):
    field, shift = normal_field(degree=degree, dtype=torch.float64), torch.tensor([0.4, -1.1, 0.7]).double()
    moved = similarity(field, torch.cat([rotation(), shift[:, None]], dim=1), 1.7)
    assert_moved(moved, field, rotation(), shift, 1.7, atol=1e-10)
    units = torch.eye((degree + 1) ** 2 - 1)[..., None].expand(-1, -1, 3)  # rounding errors would differ between runs
    assert torch.equal(rotate_spherical_harmonics(units, torch.diag(torch.tensor([1.0, 1, -1]))).abs(), units)


@pytest.mark.parametrize("far", [5e5, -4e6, 3e12])
def test_survey_coordinates_are_moved_without_loss(far):
    means = far + 50 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    means[3, 1] = torch.nan
    moved, offset = recentred(means)
    assert moved.dtype == torch.float32
    whole = moved.double() + torch.tensor(offset, dtype=torch.float64)
    torch.testing.assert_close(whole, means, rtol=0, atol=abs(far) * 2.0**-53 + 2e-6, equal_nan=True)
    # A capture's own transform leads back to the origin before anything is rounded.
    back = torch.cat([torch.eye(3), -torch.tensor(offset, dtype=torch.float64)[:, None]], dim=1)
    again = similarity({**normal_field(100, dtype=torch.float64), "means": whole}, back, 1.0)["means"]
    assert torch.equal(again[4:].float(), moved[4:])


@pytest.mark.parametrize(
    "means", [torch.rand(50, 3) + 9, torch.full((5, 3), 9e9), torch.zeros(0, 3), torch.rand(9, 3) / 0]
)
def test_other_coordinates_stay(means):
    moved, offset = recentred(means.double())
    assert offset is None
    assert torch.equal(moved, means)


Y_DOWN, Z, Y = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def ground(up, share):
    """Centres of which a share lies on the ground, and the others up to half its width above it."""
    axis = torch.nn.functional.normalize(torch.tensor(up), dim=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(axis, torch.tensor([1.0, 0.2, 0.3])), dim=0)
    values = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0))
    heights = torch.where(torch.arange(4000) < share * 4000, 0.004 * values[:, 2], 0.05 + values[:, 2])
    turn = torch.stack([side, torch.linalg.cross(axis, side), axis])
    return torch.cat([2 * values[:, :2] - 1, heights[:, None]], dim=1) @ turn


@pytest.mark.parametrize(
    ("up", "share", "found"),
    [
        (Y_DOWN, 0.3, Y_DOWN),
        ((0.0, -0.9, 0.43), 0.3, (0.0, -0.9, 0.43)),  # a first camera that looks down
        (Z, 0.5, Z),
        (Y, 0.5, Y),
        (Z, 0.3, Y_DOWN),  # a wall may be as large
        ((1.0, 0.0, 0.0), 0.6, Y_DOWN),
        (Z, 0.0, Y_DOWN),
    ],
)
def test_up_is_that_of_the_ground_else_by_convention(up, share, found):
    direction, shown = upward(ground(up, share), Y_DOWN)
    assert torch.tensor(direction) @ torch.nn.functional.normalize(torch.tensor(found), dim=0) > 0.998
    assert shown == (up == found)
    assert upward(ground(Z, 0.5)[:50], Y_DOWN) == (Y_DOWN, False)
    assert upward(ground(Z, 0.5) * (-1.0) ** (torch.arange(4000)[:, None] // 4), Y_DOWN) == (Y_DOWN, False)
