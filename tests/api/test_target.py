"""How many primitives a prune may keep for a given loss."""

from __future__ import annotations

import pytest
import torch

import sundae_ns as sn
from sundae_ns.api.target import count_for_drop, tolerated_error


@pytest.fixture(scope="module")
def ball() -> sn.Scene:
    """Points on a sphere, coloured smoothly."""
    torch.manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(2000, 3), dim=1)
    scene = sn.Scene.from_points(points, (points + 1) / 2)
    scene.field["opacities"][:] = 3.0
    return scene


@pytest.fixture(scope="module")
def views() -> list[sn.View]:
    turns = torch.arange(16) * 0.4
    eyes = torch.stack([2.5 * turns.cos(), 2.5 * turns.sin(), 0.1 * turns], dim=1)
    return [sn.View.look_at(eye, (0, 0, 0), width=48, height=48) for eye in eyes]


def test_a_loss_of_three_decibels_is_an_error_as_large_as_that_of_the_field() -> None:
    assert tolerated_error(3.0103) == pytest.approx(1e-3, rel=1e-4)


@pytest.mark.parametrize("drop", [1.0, 6.0])
def test_the_count_meets_the_tolerated_loss(drop: float, ball: sn.Scene, views: list[sn.View]) -> None:
    found = count_for_drop(ball, drop, views, sn.PruneRule())
    counts = [count for count, _ in found.curve]
    assert counts == [2000 // 2 ** (i + 1) for i in range(len(counts))]
    assert counts[-1] <= found.kept <= 2 * counts[-1] + 1
    held_out = views[::8]
    shown = [view for i, view in enumerate(views) if i % 8]
    small = sn.prune(ball, count=found.kept, views=shown, rule=sn.PruneRule())
    error = 10 ** (-sn.measure(small, ball, held_out).psnr / 10)
    assert tolerated_error(drop) / 2 < error < 2 * tolerated_error(drop)


def test_more_loss_keeps_fewer(ball: sn.Scene, views: list[sn.View]) -> None:
    one, three = (count_for_drop(ball, drop, views, sn.PruneRule()).kept for drop in (0.5, 6.0))
    assert three < one
