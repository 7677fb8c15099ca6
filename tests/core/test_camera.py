"""Camera poses between the conventions of nerfstudio and of the rasteriser, against the inverse of the pose."""

import pytest
import torch

from sundae_ns.core.camera import world_to_camera, world_to_camera_floats


@pytest.mark.parametrize("seed", range(5))
def test_both_functions_invert_the_pose_with_y_and_z_flipped(seed):
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    centre = 10 * torch.randn(3, 1, generator=generator).double()
    pose = torch.cat([rotation * torch.linalg.det(rotation), centre], dim=1).requires_grad_()
    square = torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]]).double()])
    expected = torch.linalg.inv(square @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double()))
    torch.testing.assert_close(world_to_camera(pose), expected)
    floats = world_to_camera_floats(pose.flatten().tolist())
    torch.testing.assert_close(torch.tensor(floats, dtype=torch.float64).view(4, 4), expected.detach())
    assert torch.autograd.gradcheck(world_to_camera, (pose,))
