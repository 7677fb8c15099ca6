"""Where the cameras and points of a capture stand, and what both parsers do with poses and lenses that nerfstudio's
methods get wrong.

nerfstudio's parsers are one long method each. :func:`rebound` runs a copy of such a method in which single functions
are others; everything else, to the bit, is nerfstudio's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras import camera_utils
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.errors import DataError
from sundae_ns.data.capture import rigid
from sundae_ns.data.lenses import FISHEYE, FISHEYE624, PERSPECTIVE, Lens

Array = NDArray[np.float64]

TYPES = {name: CAMERA_MODEL_TO_TYPE[name].value for name in (PERSPECTIVE, FISHEYE, FISHEYE624)}
"""nerfstudio's camera type of each kind of lens."""
STRAY = 10.0  # A camera is stray if it stands more than this many times as far from the middle as the others
FINE_STEP, COARSE_STEP = 1e-5, 1e-3
"""Steps of float32 at the cameras, as shares of their distances: coordinates are shifted from the first one on, and
cannot be used from the second one on."""


def _distances_of(centres: Array) -> tuple[Array, Array]:
    """The middle ``[3]`` of camera centres ``[N, 3]`` and the distance ``[N]`` of each from it."""
    middle = np.median(centres, axis=0)
    return middle, np.linalg.norm(centres - middle, axis=1)


def stray_cameras(centres: Array, points: Callable[[], Array | None] = lambda: None) -> NDArray[np.bool_]:
    """Cameras so far from all others that they must not set the scene's centre and scale.

    Few cameras far away may also be all that moves, in a panorama from one place. There the points are as far as they.

    Args:
        centres: camera centres ``[N, 3]``.
        points: gives points of the scene ``[M, 3]``, in the same coordinates; called only if a camera is far away.

    Returns:
        Flags ``[N]``; of fewer than four cameras none.
    """
    if len(centres) < 4:
        return np.zeros(len(centres), dtype=bool)
    middle, distances = _distances_of(centres)
    # Up to one camera in five is a stray one; where there are more, they are part of the capture.
    usual = float(np.sort(distances)[len(centres) - 1 - max(1, len(centres) // 5)])
    far = (distances > STRAY * usual) & (usual > 0)
    cloud = points() if far.any() else None
    if cloud is not None and len(cloud):
        far &= distances > STRAY * float(np.median(np.linalg.norm(cloud - middle, axis=1)))
    return far


def float32_step(centres: Array) -> float:
    """Step between float32 numbers at the coordinates of camera centres ``[N, 3]``, as a share of their distances."""
    middle, distances = _distances_of(centres)
    usual = float(np.median(distances)) or float(distances.max())
    step = float(np.spacing(np.float32(np.abs(middle).max())))
    return step / usual if usual > 0 else 0.0


def rebound(method: Any, **names: Any) -> Any:
    """A copy of a function in which global ``names`` have these values; the function itself stays as it is."""
    copy = FunctionType(
        method.__code__, {**method.__globals__, **names}, method.__name__, method.__defaults__, method.__closure__
    )
    copy.__kwdefaults__ = method.__kwdefaults__
    return copy


def replaced(module: Any, **names: Any) -> SimpleNamespace:
    """The contents of a module, with some of its functions replaced."""
    return SimpleNamespace(**{**vars(module), **names})


class _FarOutputs(DataparserOutputs):
    """A parsed capture whose transform has float64 numbers, as it leads away from survey coordinates."""

    def transform_poses_to_original_space(self, poses: Tensor, *args: Any, **options: Any) -> Tensor:
        return super().transform_poses_to_original_space(poses.double(), *args, **options)


class Placing:
    """Poses and lenses of one capture, from the file's coordinates to those of the model.

    Args:
        robust: centre and scale the scene by the cameras that stand near each other, and shift survey coordinates in
            float64. Otherwise all cameras count, in float32, as in nerfstudio.
    """

    def __init__(self, robust: bool) -> None:
        self.robust = robust
        self.offset: Array | None = None
        """Subtracted from coordinates of the file in float64, before anything becomes float32; None for nothing."""
        self.lenses: dict[Path, Lens] = {}  # Lens by the path of an image
        self.transform = torch.eye(4)[:3]
        """Rotation and translation ``[3, 4]`` of the shifted coordinates, before their scale."""
        self._growth = 1.0
        self._points: Callable[[], Array | None] = lambda: None

    def shift(
        self, frames: list[dict[str, Any]], center_method: str, points: Callable[[], Array | None], where: str
    ) -> None:
        """Make the poses of frames float64 and rigid, near the origin if float32 is too coarse where they stand.

        Survey coordinates lie millions of metres from the origin, where float32 has steps of half a metre.

        Args:
            frames: each with its ``transform_matrix``, which is replaced.
            center_method: of the parser; a user who wants no centring gets none.
            points: gives the capture's points ``[M, 3]`` in the coordinates of the poses, or None.
            where: name of the file, for the error.

        Raises:
            DataError: float32 is too coarse, and the parser is not to centre the poses.
        """
        matrices = [rigid(np.array(frame["transform_matrix"], dtype=np.float64), where) for frame in frames]
        centres = np.array([matrix[:3, 3] for matrix in matrices])
        step = float32_step(centres) if self.robust else 0.0
        if step > COARSE_STEP and center_method == "none":
            farthest = np.abs(_distances_of(centres)[0]).max()
            raise DataError(
                f"{where}: the cameras stand {farthest:.3g} from the origin, where float32 numbers are "
                f"{np.spacing(np.float32(farthest)):.2g} apart; leave out --center-method none"
            )
        self.offset = _distances_of(centres)[0] if step > FINE_STEP and center_method != "none" else None
        self._points = points
        for frame, matrix in zip(frames, matrices, strict=True):
            if self.offset is not None:
                matrix[:3, 3] -= self.offset
            frame["transform_matrix"] = matrix

    @property
    def camera_utils(self) -> SimpleNamespace:
        """nerfstudio's functions for cameras, with our way to centre and orient poses."""
        return replaced(camera_utils, auto_orient_and_center_poses=self._oriented)

    def _oriented(self, poses: Tensor, **methods: Any) -> tuple[Tensor, Tensor]:
        def points() -> Array | None:
            cloud = self._points()
            return cloud if cloud is None or self.offset is None else cloud - self.offset

        oriented, self.transform = camera_utils.auto_orient_and_center_poses(poses, **methods)
        self._growth = 1.0
        far = stray_cameras(poses[:, :3, 3].double().numpy(), points) if self.robust else np.zeros(len(poses), bool)
        if far.any():
            near, self.transform = camera_utils.auto_orient_and_center_poses(poses[torch.from_numpy(~far)], **methods)
            oriented = self.transform @ poses
            # nerfstudio divides by the largest coordinate of all cameras.
            self._growth = float(oriented[:, :3, 3].abs().max() / near[:, :3, 3].abs().max())
        return oriented, self.transform

    def points_in_model(self, points: Tensor, transform: Tensor, scale: float) -> Tensor:
        """Points ``[N, 3]`` of a capture after its offset, ``transform`` ``[3, 4]`` and ``scale``, float32."""
        if self.offset is not None:
            points = points.double() - torch.from_numpy(self.offset)
        return (points.float() @ transform[:3, :3].T + transform[:3, 3]) * scale

    def finish(self, outputs: DataparserOutputs, *, scaled: bool) -> DataparserOutputs:
        """The parsed capture with each camera's own lens, the scale of the near cameras, and the whole transform.

        Args:
            outputs: of nerfstudio's method, run with :attr:`camera_utils`; its cameras are changed in place.
            scaled: whether it has scaled the poses to the largest coordinate.
        """
        cameras, lenses = outputs.cameras, [self.lenses[path] for path in outputs.image_filenames]
        if lenses:
            types = torch.tensor([[TYPES[lens.kind]] for lens in lenses], dtype=cameras.camera_type.dtype)
            distortion = torch.tensor([lens.distortion for lens in lenses], dtype=torch.float32)
            # nerfstudio undistorts no lens whose distortion is zero, a fisheye lens neither; this one moves nothing.
            zero_fisheye = (types != CameraType.PERSPECTIVE.value).flatten() & (distortion == 0).all(dim=1)
            distortion[zero_fisheye, 0] = 1e-12
            cameras.camera_type, cameras.distortion_params = types, distortion
        if self._growth != 1.0 and scaled:
            cameras.camera_to_worlds[:, :, 3] *= self._growth
            outputs.dataparser_scale *= self._growth
            if "points3D_xyz" in outputs.metadata:
                outputs.metadata["points3D_xyz"] = outputs.metadata["points3D_xyz"] * self._growth
        if self.offset is None:
            return outputs
        transform = outputs.dataparser_transform.double()
        transform[:, 3] -= self.transform[:, :3].double() @ torch.from_numpy(self.offset)
        known = {entry.name: getattr(outputs, entry.name) for entry in fields(outputs)}
        return _FarOutputs(**{**known, "dataparser_transform": transform})
