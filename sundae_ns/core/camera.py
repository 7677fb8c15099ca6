"""Cameras with world-to-camera matrices and OpenCV axes (x right, y down, view along z), as the rasteriser takes them.

Poses are camera-to-world with OpenGL axes (x right, y up, view along -z), as nerfstudio stores them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.core.errors import ConfigError
from sundae_ns.core.values import AnyArray, numbers, usual_defaults, whole

OPENGL_TO_OPENCV = (1.0, -1.0, -1.0)  # sign of each camera axis


@usual_defaults()
def world_to_camera(pose: Tensor) -> Tensor:
    """World-to-camera ``[..., 4, 4]``, OpenCV axes, of camera-to-world ``[..., 3, 4]``, OpenGL axes; differentiable."""
    rotation = pose[..., :3] * pose.new_tensor(OPENGL_TO_OPENCV)
    top = torch.cat([rotation.mT, -rotation.mT @ pose[..., 3:]], dim=-1)
    return torch.cat([top, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]]).expand(*pose.shape[:-2], 1, 4)], dim=-2)


def world_to_camera_floats(pose: Sequence[float]) -> list[float]:
    """The 16 entries of :func:`world_to_camera` row by row, from the 12 of ``pose``, without a tensor or a kernel."""
    x, y, z = pose[3::4]
    matrix: list[float] = []
    for axis, sign in enumerate(OPENGL_TO_OPENCV):
        a, b, c = (sign * value for value in pose[axis::4])
        matrix += [a, b, c, -(a * x + b * y + c * z)]
    return [*matrix, 0.0, 0.0, 0.0, 1.0]


class Crop(NamedTuple):
    """A rectangle of an image, in pixels; ``mirrored`` exchanges left and right."""

    left: int
    top: int
    width: int
    height: int
    mirrored: bool = False


class Camera(NamedTuple):
    """A pinhole camera without distortion: pose, intrinsics and image size."""

    viewmat: Tensor  # World-to-camera, OpenCV axes ``[4, 4]``
    K: Tensor  # Intrinsics in pixels ``[3, 3]``
    width: int
    height: int
    focal: float
    """Focal length in pixels, the mean of both axes. Kept beside K, because reading K back waits for the GPU."""

    @classmethod
    def from_pose(cls, pose: AnyArray, intrinsics: AnyArray, width: int, height: int) -> Camera:
        """A pinhole camera from a pose as nerfstudio and Blender write it; all sizes in pixels.

        Args:
            pose: camera-to-world with OpenGL axes (x right, y up, view along -z), ``[3, 4]`` or ``[4, 4]``.
            intrinsics: focal lengths and principal point fx, fy, cx, cy.
            width, height: of the image.

        Raises:
            ConfigError: the pose has no rotation, or a number is out of its range.

        >>> import torch, sundae_ns as sn
        >>> sn.Camera.from_pose(torch.eye(4), (50.0, 50.0, 32.0, 24.0), 64, 48).center
        tensor([0., 0., 0.])
        """
        fx, fy, cx, cy = numbers(intrinsics, "intrinsics", (4,)).tolist()
        if not min(fx, fy) > 0:
            raise ConfigError(f"the focal lengths are {fx:g} and {fy:g}; give positive numbers of pixels")
        checked = numbers(pose.detach() if isinstance(pose, Tensor) else pose, "pose", (3, 4), (4, 4))
        given = pose if isinstance(pose, Tensor) else checked
        axes = checked[:3, :3]
        far = (axes.T @ axes - torch.eye(3, dtype=axes.dtype, device="cpu")).abs().max() > 0.25
        if far or axes.det() < 0 or (checked[3:, :3].abs() > 1e-6).any():
            raise ConfigError("the first three columns of the pose are not a rotation; give right-handed unit axes")
        K = given.new_tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float32)
        return cls(world_to_camera(given[:3].float()), K, whole(width, "width"), whole(height, "height"), (fx + fy) / 2)

    @classmethod
    def from_fov(cls, pose: AnyArray, fov: float, width: int, height: int) -> Camera:
        """As :meth:`from_pose`, with the vertical field of view in degrees and the principal point in the middle."""
        if not 0 < (angle := float(numbers(fov, "fov", ()))) < 180:
            raise ConfigError(f"fov is {angle:g}; give degrees between 0 and 180")
        focal = whole(height, "height") / 2 / math.tan(math.radians(angle) / 2)
        return cls.from_pose(pose, (focal, focal, whole(width, "width") / 2, height / 2), width, height)

    @classmethod
    def look_at(
        cls,
        eye: AnyArray,
        target: AnyArray,
        up: AnyArray = (0.0, 0.0, 1.0),
        *,
        fov: float = 60.0,
        width: int = 640,
        height: int = 480,
    ) -> Camera:
        """A camera on the CPU that looks at a point.

        Args:
            eye, target: centre of the camera, and point in the middle of the image, world units ``[3]``.
            up: direction that is upwards in the image ``[3]``; ignored if it is the viewing direction.
            fov: vertical field of view, degrees.
            width, height: of the image, pixels.

        Raises:
            ConfigError: the points are one, or a number is out of its range.

        >>> import sundae_ns as sn
        >>> sn.Camera.look_at((0, -2, 0), (0, 0, 0)).center
        tensor([ 0., -2.,  0.])
        """
        center, point, above = numbers(eye, "eye", (3,)), numbers(target, "target", (3,)), numbers(up, "up", (3,))
        if min(float((center - point).norm()), float(above.norm())) < 1e-12:
            raise ConfigError("eye and target are one point, or up is zero, so there is no direction; give others")
        return cls.from_fov(poses_looking_at(center, point, above / above.norm()), fov, width, height)

    @property
    @usual_defaults()
    def center(self) -> Tensor:
        """Camera centre, world units ``[3]``."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def pose(self) -> Tensor:
        """Camera-to-world with OpenGL axes ``[3, 4]``; the counterpart of :meth:`from_pose`."""
        rotation = self.viewmat[:3, :3].T * self.viewmat.new_tensor(OPENGL_TO_OPENCV)
        return torch.cat([rotation, self.center[:, None]], dim=1)

    def to(self, device: torch.device | str) -> Camera:
        """The camera on another device."""
        return self._replace(viewmat=self.viewmat.to(device), K=self.K.to(device))

    def zoomed(self, factor: float) -> Camera:
        """The camera with the same field of view and sides ``factor`` times as long."""
        width, height = (max(round(side * factor), 1) for side in (self.width, self.height))
        # By the rounded sizes, so that edges agree; row by row, because a tensor of numbers is copied to the device.
        K = torch.stack([self.K[0] * (width / self.width), self.K[1] * (height / self.height), self.K[2]])
        return Camera(self.viewmat, K, width, height, self.focal * factor)

    def cut(self, crop: Crop) -> Camera:
        """The camera of a window of the image; of a mirrored window, that of the mirror image."""
        viewmat, K = self.viewmat, self.K.clone()
        K[0, 2] -= crop.left
        K[1, 2] -= crop.top
        if crop.mirrored:
            viewmat = viewmat.clone()
            viewmat[0].neg_()
            K[0, 2].neg_().add_(crop.width)
        return Camera(viewmat, K, crop.width, crop.height, self.focal)


def poses_looking_at(eyes: Tensor, targets: Tensor, up: Tensor) -> Tensor:
    """Camera-to-world, OpenGL axes ``[..., 3, 4]``, of cameras at eyes that look at targets ``[..., 3]``; unit up."""
    back = torch.nn.functional.normalize(eyes - targets, dim=-1)
    right = torch.linalg.cross(up.expand_as(back), back)
    other = torch.linalg.cross(torch.nn.functional.one_hot(back.abs().argmin(dim=-1), 3).to(back), back)
    right = torch.where(right.norm(dim=-1, keepdim=True) < 1e-6, other, right)
    right = torch.nn.functional.normalize(right, dim=-1)
    return torch.stack([right, torch.linalg.cross(back, right), back, eyes], dim=-1)


def crop_image(image: Tensor, crop: Crop | None) -> Tensor:
    """A window of an image ``[H, W, C]``; None for the whole image."""
    if crop is None:
        return image
    window = image[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
    return window.flip(1) if crop.mirrored else window
