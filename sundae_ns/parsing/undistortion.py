"""Perspective images of photos: nerfstudio's undistortion, with lenses that see the half space, and wrong distortions.

OpenCV chooses the focal length of a fisheye photo's perspective image by the rays at the middles of its edges. Rays at
90 degrees and more have no place in a perspective image, and the focal length becomes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.datamanagers import full_images_datamanager
from numpy.typing import NDArray

from sundae_ns.errors import DataError, one_line

Result = tuple[NDArray[Any], NDArray[Any], Any]
"""Intrinsics ``[3, 3]``, image ``[H, W, C]`` and mask."""
WIDEST = 60.0
"""Half the angle of view of the perspective image of a lens that sees too much for one, degrees."""
_LEAST_SHARE = 0.1
"""Focal length in widths of the image, of a view of 157 degrees; wider ones show a smear."""
_MOST_SHARE = 1000.0


def undistorting(paths: Sequence[Path]) -> Callable[..., Result]:
    """A function in place of nerfstudio's that undistorts one image, for images with these paths.

    It raises ``DataError`` for a distortion that no image can have.
    """

    def undistort(camera: Any, distortion_params: Any, data: Any, image: Any, K: Any) -> Result:
        path, intrinsics = paths[int(data["image_idx"])], K.copy()
        try:
            new, result, mask = full_images_datamanager._undistort_image(camera, distortion_params, data, image, K)
        except (AssertionError, LookupError, TypeError, ValueError, cv2.error) as error:
            raise DataError(
                f"{path.name} cannot be undistorted ({one_line(error)}); {_check(distortion_params)}"
            ) from error
        share = float(new[0, 0]) / max(result.shape[1], 1)
        usable = np.isfinite(new).all() and _LEAST_SHARE <= share <= _MOST_SHARE and (result.any() or not image.any())
        if usable:
            return new, result, mask
        if int(camera.camera_type) != CameraType.FISHEYE.value or not _is_lens(distortion_params, intrinsics, image):
            raise DataError(f"{path.name} has a distortion that leaves no image; {_check(distortion_params)}")
        return _middle(intrinsics, distortion_params, image, data.get("mask"))

    return undistort


def _check(distortion: Any) -> str:
    values = ", ".join(f"{float(value):.3g}" for value in distortion)
    return f"check its k1 ... p2 ({values}), which are of coordinates in focal lengths, not in pixels"


def _is_lens(distortion: Any, K: NDArray[Any], image: NDArray[Any]) -> bool:
    """Whether rays at larger angles lie farther out, up to the edges of a fisheye photo or to 90 degrees."""
    theta = np.linspace(0, np.pi / 2, 500)
    radius = theta * (1 + sum(float(k) * theta ** (2 * i + 2) for i, k in enumerate(distortion[:4])))
    outside = radius >= min(image.shape[1] / 2 / K[0, 0], image.shape[0] / 2 / K[1, 1])
    last = int(np.argmax(outside)) if outside.any() else len(theta) - 1
    return bool((np.diff(radius[: last + 1]) > 0).all())


def _middle(K: NDArray[Any], distortion: Any, image: NDArray[Any], mask: Any) -> Result:
    """The perspective image of the middle of a fisheye photo, to :data:`WIDEST` at the middles of its edges."""
    height, width = image.shape[:2]
    # OpenCV's pixels have whole numbers at their middles.
    own = K.astype(np.float64)
    own[:2, 2] -= 0.5
    k = np.array(distortion[:4], dtype=np.float64)
    angle = np.radians(WIDEST)
    focal = max(width, height) / 2 / np.tan(angle)
    new = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    maps = cv2.fisheye.initUndistortRectifyMap(own, k, np.eye(3), new, (width, height), cv2.CV_32FC1)
    seen = (maps[0] > -0.5) & (maps[0] < width - 0.5) & (maps[1] > -0.5) & (maps[1] < height - 0.5)
    if mask is not None:
        stored = mask.numpy().astype(np.uint8).reshape(height, width) * 255
        seen &= cv2.remap(stored, *maps, interpolation=cv2.INTER_LINEAR) > 127
    drawn = cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR)
    new[:2, 2] += 0.5
    whole = None if mask is None and seen.all() else torch.from_numpy(seen)[..., None]
    return new.astype(np.float32), drawn, whole
