"""Camera paths between neighbours."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.scenes.flicker import between, neighbours


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
