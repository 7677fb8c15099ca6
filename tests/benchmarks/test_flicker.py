"""Warped frames of a wall whose colours are known everywhere, and camera paths between neighbours."""

from __future__ import annotations

import math

import pytest
import torch
from flicker import Flicker, Frame, between, neighbours, warp
from torch import Tensor

from sundae_ns.errors import DataError

HEIGHT, WIDTH, FOCAL, FAR = 24, 32, 30.0, 4.0


def wall(shift: float, *brightness: float, depth: float = FAR, turn: float = 0.0) -> Frame:
    """A wall at one depth from a camera that has moved along x and turned about y, one image for each brightness.

    Colours are linear in the place on the wall, which bicubic sampling keeps.
    """
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    c, s = torch.cos(torch.tensor(turn)), torch.sin(torch.tensor(turn))
    viewmat = torch.eye(4)
    viewmat[0, 0], viewmat[0, 2], viewmat[2, 0], viewmat[2, 2] = c, s, -s, c
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([shift, 0.0, 0.0])
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    rays = torch.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, torch.ones_like(x)], dim=-1)
    directions = rays @ viewmat[:3, :3]  # world axes
    z = depth / directions[..., 2]  # along the optical axis, to the wall
    place = directions * z[..., None] + torch.tensor([shift, 0.0, 0.0])
    color = torch.stack([0.5 + 0.05 * place[..., 0], 0.5 + 0.05 * place[..., 1], 0.1 * place[..., 2]], dim=-1)
    images = torch.stack([color + extra for extra in (brightness or (0.0,))])
    return Frame(images, z[..., None], torch.ones(HEIGHT, WIDTH, 1), viewmat, K)


def inner(seen: Tensor) -> Tensor:
    """Pixels whose bicubic neighbourhood lies inside the earlier frame: at its edge colours are no longer linear."""
    return seen[3:-3, 6:-6]


@pytest.mark.parametrize(("shift", "turn"), [(0.0, 0.0), (0.3, 0.0), (-0.2, 0.1)])
def test_a_wall_looks_the_same_from_both_places(shift: float, turn: float) -> None:
    later = wall(shift, turn=turn)
    images, seen = warp(wall(0.0), later)
    assert inner(seen).all()
    # Worst measured: 1.2e-4, where the turned wall is not quite linear over the pixels.
    assert (images - later.images)[:, 3:-3, 6:-6].abs().max() < 5e-4


def test_what_left_the_image_or_lies_elsewhere_is_not_seen() -> None:
    _, seen = warp(wall(0.0), wall(2.0))
    moved = round(2.0 * FOCAL / FAR)
    assert seen[:, : WIDTH - moved].all()
    assert not seen[:, WIDTH - moved :].any()
    assert not warp(wall(0.0), wall(0.1, depth=1.1 * FAR))[1].any()
    thin = wall(0.1)
    assert not warp(wall(0.0), thin._replace(alpha=0.5 * thin.alpha))[1].any()


def test_flicker_is_what_one_method_has_beyond_the_other() -> None:
    flicker = Flicker()
    assert (flicker.errors(), flicker.excess(), flicker.seen) == ([], [], 0.0)
    for number in range(4):
        flicker.add(wall(0.0, 0.1 * (number % 2), 0.02), wall(0.0, 0.1 * ((number + 1) % 2), 0.02))
    assert flicker.seen > 0.9
    assert flicker.errors() == pytest.approx([0.01, 0.0], abs=1e-6)
    assert flicker.excess() == pytest.approx([0.01, 0.0], abs=1e-6)


def test_flicker_is_unknown_where_frames_share_no_pixel() -> None:
    flicker = Flicker()
    flicker.add(wall(0.0, 0.1, 0.0), wall(0.1, 0.1, 0.0, depth=1.1 * FAR))
    assert flicker.seen == 0
    assert all(math.isnan(figure) for figure in (*flicker.errors(), *flicker.excess()))
    assert len(flicker.errors()) == 2


def test_an_error_of_both_is_no_flicker() -> None:
    flicker = Flicker()
    flicker.add(wall(0.0, 0.0, 0.0), wall(0.0, 0.2, 0.1))
    assert flicker.errors() == pytest.approx([0.04, 0.01], abs=1e-6)
    assert flicker.excess() == pytest.approx([0.03, 0.0], abs=1e-6)


def pose(x: float, degrees: float = 0.0) -> Tensor:
    """Camera-to-world at ``x``, turned about the y axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.tensor([[c, 0, s, x], [0, 1, 0, 0], [-s, 0, c, 0]], dtype=torch.float64)


def test_pairs_are_spread_over_the_capture_and_look_the_same_way() -> None:
    # Every other camera looks the other way, from a place nearer by.
    poses = torch.stack([pose(0.4 * i, 180.0 * (i % 2)) for i in range(12)])
    pairs = neighbours(poses, 3)
    assert [first for first, _ in pairs] == [3, 6, 8]
    assert all(abs(first - second) == 2 for first, second in pairs)
    assert neighbours(poses[:2], 3) == [(0, 1), (1, 0)]  # nothing else to go to
    with pytest.raises(DataError, match="two training views"):
        neighbours(poses[:1], 3)


def test_a_path_goes_from_one_pose_towards_the_other() -> None:
    first, second = pose(0.0), pose(1.0, 40.0)
    assert torch.allclose(between(first, second, 0.0), first)
    assert torch.allclose(between(first, second, 1.0), second)
    middle = between(first, second, 0.5)
    assert torch.allclose(middle, pose(0.5, 20.0))
    assert torch.linalg.det(middle[:, :3]) == pytest.approx(1.0)
