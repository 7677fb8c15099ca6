"""Views of nerfstudio's cameras: their matrices, their resolution in training, and windows of their images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.plugin.dataparsers import camera_of
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.scene.render import StepResolution

Build = Callable[..., SundaeModel]
Perturb = Callable[[SundaeModel], SundaeModel]
MakeCamera = Callable[..., Cameras]
MakeBatch = Callable[..., dict[str, Tensor]]
TrainingOf = Callable[[SundaeModel], Any]


@torch.no_grad()
def test_a_primitive_lands_where_the_pinhole_says(build: Build, camera: MakeCamera) -> None:
    xyz = torch.tensor([[0.55, 0.35, 0.0]])
    model = build(seed_points=(xyz, torch.zeros(1, 3, dtype=torch.uint8))).eval()
    model.gauss_params["scales"].data.fill_(-5)
    alpha = model.get_outputs_for_camera(camera())["accumulation"][..., 0]
    row, column = divmod(int(alpha.argmax()), 40)
    # In front of the camera by 3; x to the right, y up, pixel centres at one half.
    assert (column, row) == (int(20 + 30 * 0.55 / 3), int(16 - 30 * 0.25 / 3))


@pytest.mark.parametrize(("step", "mirrored"), [(10, True), (11, False)])
def test_a_window_is_a_part_of_the_whole_picture(
    build: Build,
    perturb: Perturb,
    camera: MakeCamera,
    batch: MakeBatch,
    monkeypatch: pytest.MonkeyPatch,
    step: int,
    mirrored: bool,
) -> None:
    """Pictures, truth and mask of a window are what the whole picture shows there, or its mirror image."""
    whole, cut = (perturb(build(head={"max_train_pixels": limit}, background_color="black")) for limit in (0, 600))
    with torch.no_grad():
        # Rasterisers clamp how they linearise large Gaussians far outside of the picture, and a window is a picture.
        whole.gauss_params["scales"] -= 2
    cut.load_state_dict(whole.state_dict())
    masked = {**batch(), "mask": torch.rand(32, 40, 1, generator=torch.Generator().manual_seed(4)) > 0.5}
    for model in (whole, cut):
        model.train()
        model.step = step
    monkeypatch.setattr(whole, "resolution", lambda step: StepResolution(step, 1, 0))
    outputs = {model: model.get_outputs(camera()) for model in (whole, cut)}
    crop = outputs[cut]["window"]
    assert outputs[whole]["window"] is None
    assert crop.width * crop.height <= 600
    assert crop.mirrored == mirrored

    def part(image: Tensor) -> Tensor:
        seen = image[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
        return seen.flip(1) if mirrored else seen

    for name in ("base_rgb", "accumulation"):
        torch.testing.assert_close(outputs[cut][name], part(outputs[whole][name]), atol=1e-5, rtol=0)
    truth = part(whole.truth(masked, outputs[whole]))
    assert torch.equal(cut.truth(masked, outputs[cut]), truth)
    losses = cut.get_loss_dict(outputs[cut], masked, {})
    expected = ((outputs[cut]["base_rgb"] - truth).abs() * part(masked["mask"])).mean()
    torch.testing.assert_close(losses["base_loss"], cut.config.base_loss_weight * expected)


def test_windows_wait_for_the_head_and_for_densification(build: Build, perturb: Perturb, camera: MakeCamera) -> None:
    model = build(head={"max_train_pixels": 600})
    assert not model.state.head_enabled
    assert model.resolution(0) == StepResolution(0, 1, 0)
    perturb(model)
    assert model.resolution(0) == StepResolution(0, 1, 600, mirror=True)
    assert model.eval().get_outputs(camera())["rgb"].shape == (32, 40, 3)  # what is shown is whole
    early = perturb(
        build(head={"max_train_pixels": 600, "start_at": 0}, pruning={"mode": "continuous", "start": 5, "stop": 50})
    )
    assert early.state.head_enabled
    assert early.resolution(0) == StepResolution(0, 1, 0)  # densification takes its statistics from whole pictures
    paper = perturb(build(head={"mode": "features"}))
    assert not paper.resolution(0).mirror


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
    cam = camera_of(camera, "cpu", downscale=downscale)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = cameras.camera_to_worlds[index].double() * torch.tensor([1.0, -1.0, -1.0, 1.0])
    torch.testing.assert_close(cam.viewmat.double(), torch.linalg.inv(pose), rtol=1e-5, atol=1e-5)
    K = cameras.get_intrinsics_matrices()[index].clone()
    K[:2] /= downscale
    torch.testing.assert_close(cam.K, K, rtol=1e-6, atol=0)
    assert (cam.width, cam.height) == (
        int(cameras.width[index]) // downscale,
        int(cameras.height[index]) // downscale,
    )
    torch.testing.assert_close(torch.tensor(cam.focal), K[[0, 1], [0, 1]].mean(), rtol=1e-6, atol=0)
    for name in ("camera_to_worlds", "fx", "cy", "width"):
        assert torch.equal(getattr(cameras, name), getattr(made(seed), name)), "the camera does not change"
    assert cam.viewmat.is_contiguous()
    assert cam.K.is_contiguous()


def test_a_pose_that_learns_gives_the_same_view_and_a_gradient() -> None:
    camera = made(0)[1:2]
    pose = camera.camera_to_worlds.clone().requires_grad_()
    plain, learned = camera_of(camera, "cpu"), camera_of(camera, "cpu", pose=pose)
    torch.testing.assert_close(plain.viewmat, learned.viewmat.detach(), rtol=1e-6, atol=1e-5)
    assert torch.equal(plain.K, learned.K)
    assert plain[2:] == learned[2:]
    learned.viewmat[:3].sum().backward()  # type: ignore[no-untyped-call]
    assert pose.grad is not None
    assert (pose.grad != 0).any()


def test_a_view_keeps_no_hold_of_its_camera() -> None:
    camera = made(0)[:1]
    cam = camera_of(camera, "cpu")
    before = cam.viewmat.clone()
    camera.camera_to_worlds.mul_(2)
    assert torch.equal(cam.viewmat, before)
