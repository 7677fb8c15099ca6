"""Cameras as the rasteriser takes them, and windows of their pictures."""

from __future__ import annotations

import copy
from collections.abc import Sequence
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
        width, height = _zoomed_size(self.width, self.height, factor)
        # By what rounding made of the factor, so that the pictures' edges agree. Row by row, for numbers in a tensor would
        # have to be copied to the device, and waited for.
        K = torch.stack([self.K[0] * (width / self.width), self.K[1] * (height / self.height), self.K[2]])
        return View(self.viewmat, K, width, height, self.focal * factor)

    def cut(self, window: Window) -> View:
        """The camera that sees this window of the picture alone."""
        K = self.K.clone()
        K[0, 2] -= window.left
        K[1, 2] -= window.top
        return View(self.viewmat, K, window.width, window.height, self.focal)


def zoomed(camera: Cameras, factor: float) -> Cameras:
    """Nerfstudio's camera of shape ``(1,)`` that sees the same in a picture whose sides are ``factor`` times as long.

    Its view has the size and the intrinsics of :meth:`View.zoomed`. Nerfstudio's own method rounds the sides and not the
    intrinsics, after which the picture's edges lie elsewhere than those of the truth resized.
    """
    before = int(camera.width), int(camera.height)
    width, height = _zoomed_size(*before, factor)
    x, y = width / before[0], height / before[1]
    result = copy.deepcopy(camera)
    result.fx, result.cx, result.fy, result.cy = camera.fx * x, camera.cx * x, camera.fy * y, camera.cy * y
    result.width, result.height = torch.full_like(camera.width, width), torch.full_like(camera.height, height)
    return result


def _zoomed_size(width: int, height: int, factor: float) -> tuple[int, int]:
    """Width and height of a picture whose sides are ``factor`` times as long, in whole pixels."""
    return max(round(width * factor), 1), max(round(height * factor), 1)


def view_of(camera: Cameras, device: torch.device | str, *, pose: Tensor | None = None, downscale: int = 1) -> View:
    """The rasteriser's form of a camera of shape ``(1,)``; nothing in ``camera`` is changed.

    Args:
        camera: nerfstudio camera, camera-to-world with OpenGL axes.
        device: where the view is to be.
        pose: camera-to-world, if not the camera's own, ``[..., 3, 4]``; differentiable.
        downscale: divide the resolution by this.
    """
    *flat, fx, fy, cx, cy, width, height = _numbers(camera)
    dtype = camera.camera_to_worlds.dtype
    K = [fx / downscale, 0.0, cx / downscale, 0.0, fy / downscale, cy / downscale, 0.0, 0.0, 1.0]
    size = (int(width) // downscale, int(height) // downscale)
    if pose is None:
        both = torch.tensor([*_world_to_camera(flat), *K], dtype=dtype).to(device)  # in one piece: one copy to a GPU
        viewmat, intrinsics = both[:16].view(4, 4), both[16:].view(3, 3)
    else:
        pose = pose.reshape(-1, 3, 4)[0]
        rotation = pose[:, :3] * pose.new_tensor([1.0, -1.0, -1.0])
        top = torch.cat([rotation.T, -rotation.T @ pose[:, 3:]], dim=1)
        viewmat = torch.cat([top, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])]).to(device)
        intrinsics = torch.tensor(K, dtype=dtype).to(device).view(3, 3)
    return View(viewmat, intrinsics, *size, (fx + fy) / 2 / downscale)


def _numbers(camera: Cameras) -> list[float]:
    """Camera-to-world row by row, focal lengths, centre and size; in one piece, since from a GPU each would be waited for.

    Read by itself, because nerfstudio's methods of cameras build tensors and cameras anew, at every step and frame.
    """
    parts = (camera.camera_to_worlds, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return torch.cat([part.detach().flatten() for part in parts]).tolist()  # type: ignore[no-any-return]


def _world_to_camera(pose: Sequence[float]) -> list[float]:
    """World-to-camera, OpenCV axes, from camera-to-world ``3 x 4``, OpenGL axes; both row by row."""
    x, y, z = pose[3::4]
    matrix: list[float] = []
    for axis, sign in enumerate((1.0, -1.0, -1.0)):
        a, b, c = (sign * value for value in pose[axis::4])
        matrix += [a, b, c, -(a * x + b * y + c * z)]
    return [*matrix, 0.0, 0.0, 0.0, 1.0]


def cut(image: Tensor, window: Window | None) -> Tensor:
    """A window of an image ``[H, W, C]``; None for all of it."""
    if window is None:
        return image
    return image[window.top : window.top + window.height, window.left : window.left + window.width]
