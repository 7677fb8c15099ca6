"""What both parsers do with poses and lenses that nerfstudio's methods get wrong.

nerfstudio's parsers are one long method each. :func:`rebound` runs a copy of such a method in which single functions
are others; everything else, to the bit, is nerfstudio's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras import camera_utils
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from torch import Tensor

from sundae_ns.data.capture import rigid
from sundae_ns.data.frame import COARSE_STEP, Array, far_offset, float32_step, stray_cameras
from sundae_ns.data.lenses import FISHEYE, FISHEYE624, PERSPECTIVE, Lens
from sundae_ns.errors import DataError

TYPES = {name: CAMERA_MODEL_TO_TYPE[name].value for name in (PERSPECTIVE, FISHEYE, FISHEYE624)}
"""nerfstudio's camera type of each kind of lens."""
_NEARLY_NONE = 1e-12
"""A distortion that moves nothing; nerfstudio undistorts no lens whose distortion is zero, a fisheye lens neither."""


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
        """As nerfstudio's, in float64."""
        return super().transform_poses_to_original_space(poses.double(), *args, **options)


class Placing:
    """Poses and lenses of one capture, from the file's coordinates to those of the model.

    Args:
        robust: centre and scale the scene by the cameras that stand near each other, and shift survey coordinates in
            float64. Otherwise all cameras count, in float32, as in nerfstudio and in runs of earlier versions.
    """

    def __init__(self, robust: bool) -> None:
        self.robust = robust
        self.offset: Array | None = None
        """Subtracted from coordinates of the file in float64, before anything becomes float32; None for nothing."""
        self.lenses: dict[Any, Lens] = {}
        """Lens by the path of an image."""
        self.transform = torch.eye(4)[:3]
        """Rotation and translation ``[3, 4]`` of the shifted coordinates, before their scale."""
        self._growth = 1.0
        self._points: Any = lambda: None

    def shift(self, poses: list[Any], center_method: str, points: Any, where: str) -> list[np.ndarray]:
        """Camera-to-world matrices ``[4, 4]`` in float64, shifted near the origin if float32 is too coarse for them.

        Args:
            poses: matrices of all cameras.
            center_method: of the parser; a user who wants no centring gets none.
            points: gives the capture's points ``[M, 3]`` in the coordinates of the poses, or None.
            where: name of the file, for the error.

        Raises:
            DataError: float32 is too coarse, and the parser is not to centre the poses.
        """
        matrices = [rigid(np.array(pose, dtype=np.float64), where) for pose in poses]
        centres = np.array([matrix[:3, 3] for matrix in matrices])
        offset = far_offset(centres) if self.robust else None
        if offset is not None and center_method == "none":
            if float32_step(centres) > COARSE_STEP:
                raise DataError(
                    f"{where}: the cameras stand {np.abs(offset).max():.3g} from the origin, where float32 numbers are "
                    f"{np.spacing(np.float32(np.abs(offset).max())):.2g} apart; leave out --center-method none"
                )
            offset = None
        self.offset = offset
        self._points = points
        if offset is not None:
            for matrix in matrices:
                matrix[:3, 3] -= offset
        return matrices

    @property
    def camera_utils(self) -> SimpleNamespace:
        """nerfstudio's functions for cameras, with our way to centre and orient poses."""
        return replaced(camera_utils, auto_orient_and_center_poses=self._oriented)

    def _oriented(self, poses: Tensor, **methods: Any) -> tuple[Tensor, Tensor]:
        oriented, transform = camera_utils.auto_orient_and_center_poses(poses, **methods)
        stray = np.zeros(len(poses), dtype=bool)
        if self.robust:
            stray = stray_cameras(poses[:, :3, 3].double().numpy(), self._near_points)
        self._growth = 1.0
        if stray.any():
            near = torch.from_numpy(~stray)
            kept, transform = camera_utils.auto_orient_and_center_poses(poses[near], **methods)
            oriented = transform @ poses
            # nerfstudio divides by the largest coordinate of all cameras.
            self._growth = float(oriented[:, :3, 3].abs().max() / kept[:, :3, 3].abs().max())
        self.transform = transform
        return oriented, transform

    def _near_points(self) -> Array | None:
        points = self._points()
        return points if points is None or self.offset is None else points - self.offset

    def finish(self, outputs: DataparserOutputs, *, scaled: bool) -> DataparserOutputs:
        """The parsed capture with each camera's own lens, the scale of the near cameras, and the whole transform.

        Args:
            outputs: of nerfstudio's method, run with :attr:`camera_utils`; its cameras are changed in place.
            scaled: whether it has scaled the poses to the largest coordinate.
        """
        self._set_lenses(outputs)
        if self._growth != 1.0 and scaled:
            outputs.cameras.camera_to_worlds[:, :, 3] *= self._growth
            outputs.dataparser_scale *= self._growth
            if "points3D_xyz" in outputs.metadata:
                outputs.metadata["points3D_xyz"] = outputs.metadata["points3D_xyz"] * self._growth
        if self.offset is None:
            return outputs
        transform = outputs.dataparser_transform.double()
        transform[:, 3] -= self.transform[:, :3].double() @ torch.from_numpy(self.offset)
        known = {field.name: getattr(outputs, field.name) for field in fields(outputs)}
        return _FarOutputs(**{**known, "dataparser_transform": transform})

    def _set_lenses(self, outputs: DataparserOutputs) -> None:
        cameras = outputs.cameras
        lenses = [self.lenses[path] for path in outputs.image_filenames]
        if not lenses:
            return
        cameras.camera_type = torch.tensor([[TYPES[lens.kind]] for lens in lenses], dtype=cameras.camera_type.dtype)
        distortion = torch.tensor([lens.distortion for lens in lenses], dtype=torch.float32)
        round_lens = cameras.camera_type.flatten() != CameraType.PERSPECTIVE.value
        distortion[round_lens & (distortion == 0).all(dim=1), 0] = _NEARLY_NONE
        cameras.distortion_params = distortion


def check_one_kind(lenses: Mapping[Any, Lens], where: str) -> None:
    """Raise ``DataError`` for lenses that nerfstudio cannot hold together: their distortions differ in length."""
    kinds = {lens.kind for lens in lenses.values()}
    if FISHEYE624 in kinds and len(kinds) > 1:
        counts = {kind: sum(lens.kind == kind for lens in lenses.values()) for kind in sorted(kinds)}
        shown = ", ".join(f"{count} images with {kind}" for kind, count in counts.items())
        raise DataError(f"{where}: FISHEYE624 cannot be mixed with other lenses ({shown}); undistort the images first")
