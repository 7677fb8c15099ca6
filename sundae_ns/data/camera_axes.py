"""Camera poses from nerfstudio's convention to the rasteriser's.

nerfstudio stores camera-to-world with OpenGL axes (x right, y up, view along -z). The rasteriser takes world-to-camera
with OpenCV axes (x right, y down, view along z). Both functions invert the rigid motion and flip y and z.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

OPENGL_TO_OPENCV = (1.0, -1.0, -1.0)
"""Sign of each camera axis."""


def world_to_camera(pose: Tensor) -> Tensor:
    """World-to-camera matrices ``[..., 4, 4]``, OpenCV axes, of camera-to-world ``[..., 3, 4]``, OpenGL axes.

    Differentiable.
    """
    rotation = pose[..., :3] * pose.new_tensor(OPENGL_TO_OPENCV)
    top = torch.cat([rotation.mT, -rotation.mT @ pose[..., 3:]], dim=-1)
    bottom = pose.new_tensor([[0.0, 0.0, 0.0, 1.0]]).expand(*pose.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def world_to_camera_floats(pose: Sequence[float]) -> list[float]:
    """The 16 entries of :func:`world_to_camera` row by row, from the 12 of ``pose``, without a tensor or a kernel."""
    x, y, z = pose[3::4]
    matrix: list[float] = []
    for axis, sign in enumerate(OPENGL_TO_OPENCV):
        a, b, c = (sign * value for value in pose[axis::4])
        matrix += [a, b, c, -(a * x + b * y + c * z)]
    return [*matrix, 0.0, 0.0, 0.0, 1.0]
