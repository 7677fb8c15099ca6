"""Camera poses between the conventions of nerfstudio and of the rasteriser, against the inverse of the pose."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sundae_ns.core.camera import world_to_camera, world_to_camera_floats


def random_pose(seed: int) -> Tensor:
    """Camera-to-world ``[3, 4]`` float64."""
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    return torch.cat(
        [rotation * torch.linalg.det(rotation), 10 * torch.randn(3, 1, generator=generator).double()], dim=1
    )


@pytest.mark.parametrize("seed", range(5))
def test_both_functions_invert_the_pose_with_y_and_z_flipped(seed: int) -> None:
    pose = random_pose(seed)
    square = torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]]).double()])
    expected = torch.linalg.inv(square @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double()))
    torch.testing.assert_close(world_to_camera(pose), expected)
    floats = world_to_camera_floats(pose.flatten().tolist())
    torch.testing.assert_close(torch.tensor(floats, dtype=torch.float64).view(4, 4), expected)


def test_a_point_in_front_and_below_has_positive_z_and_y() -> None:
    pose = torch.tensor([[1.0, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7]])
    point = torch.tensor([5.5, 5.0, 4.0, 1.0])  # half a unit to the right, one below, three in front of the camera
    assert (world_to_camera(pose) @ point).tolist() == [0.5, 1.0, 3.0, 1.0]


def test_gradients_reach_the_pose() -> None:
    pose = random_pose(0).requires_grad_()
    assert torch.autograd.gradcheck(world_to_camera, (pose,))
