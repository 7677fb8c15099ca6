"""Views against nerfstudio's own matrices, and with a pose that learns."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st
from nerfstudio.cameras.cameras import Cameras

from sundae_ns.gaussians.covariance import rotation_matrices
from sundae_ns.rendering.views import view_of


def made(seed: int, count: int = 3) -> Cameras:
    generator = torch.Generator().manual_seed(seed)
    poses = torch.cat(
        [
            rotation_matrices(torch.randn(count, 4, generator=generator)),
            10 * torch.randn(count, 3, 1, generator=generator),
        ],
        dim=2,
    )
    focal = 50 + 100 * torch.rand(count, 2, 1, generator=generator)
    width, height = torch.randint(1, 5000, (2, count, 1), generator=generator)
    return Cameras(poses, focal[:, 0], focal[:, 1], width / 2 + 3, height / 2 - 5, width=width, height=height)


@given(seed=st.integers(0, 10**6), downscale=st.integers(1, 4), index=st.integers(0, 2))
def test_a_view_is_what_the_matrices_say(seed: int, downscale: int, index: int) -> None:
    """World-to-camera is the inverse of the pose with y and z turned; intrinsics shrink with the picture."""
    cameras = made(seed)
    camera = cameras[index : index + 1]
    view = view_of(camera, "cpu", downscale=downscale)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = cameras.camera_to_worlds[index].double() * torch.tensor([1.0, -1.0, -1.0, 1.0])
    torch.testing.assert_close(view.viewmat.double(), torch.linalg.inv(pose), rtol=1e-5, atol=1e-5)
    K = cameras.get_intrinsics_matrices()[index].clone()
    K[:2] /= downscale
    torch.testing.assert_close(view.K, K, rtol=1e-6, atol=0)
    assert (view.width, view.height) == (
        int(cameras.width[index]) // downscale,
        int(cameras.height[index]) // downscale,
    )
    torch.testing.assert_close(torch.tensor(view.focal), K[[0, 1], [0, 1]].mean(), rtol=1e-6, atol=0)
    for name in ("camera_to_worlds", "fx", "cy", "width"):
        assert torch.equal(getattr(cameras, name), getattr(made(seed), name)), "the camera does not change"
    assert view.viewmat.is_contiguous()
    assert view.K.is_contiguous()


def test_a_pose_that_learns_gives_the_same_view_and_a_gradient() -> None:
    camera = made(0)[1:2]
    pose = camera.camera_to_worlds.clone().requires_grad_()
    plain, learned = view_of(camera, "cpu"), view_of(camera, "cpu", pose=pose)
    torch.testing.assert_close(plain.viewmat, learned.viewmat.detach(), rtol=1e-6, atol=1e-5)
    assert torch.equal(plain.K, learned.K)
    assert plain[2:] == learned[2:]
    learned.viewmat[:3].sum().backward()  # type: ignore[no-untyped-call]
    assert pose.grad is not None
    assert (pose.grad != 0).any()


def test_a_view_keeps_no_hold_of_its_camera() -> None:
    camera = made(0)[:1]
    view = view_of(camera, "cpu")
    before = view.viewmat.clone()
    camera.camera_to_worlds.mul_(2)
    assert torch.equal(view.viewmat, before)
