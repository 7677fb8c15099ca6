"""Cameras as the rasteriser takes them, and windows of their pictures."""

from __future__ import annotations

from typing import NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sundae_ns.compensation import Window
from sundae_ns.rasterization.projection import camera_center


class View(NamedTuple):
    """One camera for the rasteriser."""

    viewmat: Tensor
    """World-to-camera, OpenCV axes ``[4, 4]``."""
    K: Tensor
    """Intrinsics in pixels ``[3, 3]``."""
    width: int
    height: int

    focal: float
    """Focal length in pixels, the mean of both axes; beside K, because reading K back would wait for the GPU."""

    @property
    def center(self) -> Tensor:
        """Where the camera stands ``[3]``."""
        return camera_center(self.viewmat)

    def zoomed(self, factor: float) -> View:
        """The camera that sees the same in a picture whose sides are ``factor`` times as long."""
        width, height = (max(round(side * factor), 1) for side in (self.width, self.height))
        # By what rounding made of the factor, so that the pictures' edges agree.
        scale = self.K.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return View(self.viewmat, self.K * scale, width, height, self.focal * factor)

    def cut(self, window: Window) -> View:
        """The camera that sees this window of the picture alone."""
        K = self.K.clone()
        K[0, 2] -= window.left
        K[1, 2] -= window.top
        return View(self.viewmat, K, window.width, window.height, self.focal)


def view_of(camera: Cameras, device: torch.device | str, *, pose: Tensor | None = None, downscale: int = 1) -> View:
    """The rasteriser's form of a camera of shape ``(1,)``; nothing in ``camera`` is changed.

    Args:
        camera: nerfstudio camera, camera-to-world with OpenGL axes.
        device: where the view is to be.
        pose: camera-to-world, if not the camera's own, ``[..., 3, 4]``; differentiable.
        downscale: divide the resolution by this.
    """
    if pose is None:
        # Small sums on single numbers: on a GPU each would cost a launch, and each number read back a wait.
        camera = camera.to("cpu")
        pose = camera.camera_to_worlds
    pose = pose.reshape(-1, 3, 4)[0]
    rotation = pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0])
    top = torch.cat([rotation.T, -rotation.T @ pose[:, 3:]], dim=1)
    viewmat = torch.cat([top, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])])
    K = camera.get_intrinsics_matrices().reshape(-1, 3, 3)[0].clone()
    K[:2] /= downscale
    size = (int(camera.width.item()) // downscale, int(camera.height.item()) // downscale)
    focal = (camera.fx + camera.fy).item() / 2 / downscale
    return View(viewmat.to(device), K.to(device), *size, focal)


def cut(image: Tensor, window: Window | None) -> Tensor:
    """A window of an image ``[H, W, C]``; None for all of it."""
    if window is None:
        return image
    return image[window.top : window.top + window.height, window.left : window.left + window.width]
