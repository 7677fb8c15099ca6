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
        if int(camera.camera_type) == CameraType.PERSPECTIVE.value and distortion_params[3]:
            found = _of_brown(intrinsics, distortion_params, image, data.get("mask"))
            if found is None:
                raise DataError(f"{path.name} has a distortion that leaves no image; {_check(distortion_params)}")
            return found
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


def _brown(x: NDArray[Any], y: NDArray[Any], distortion: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Distorted coordinates, in focal lengths, by the model of Brown with k1 ... k4, p1, p2; as OpenCV's for k4 = 0."""
    k1, k2, k3, k4, p1, p2 = map(float, distortion)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return across, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def _of_brown(K: NDArray[Any], distortion: Any, image: NDArray[Any], mask: Any) -> Result | None:
    """The largest perspective image that a photo fills, by all four radial coefficients; OpenCV has three of them.

    None if no image of a quarter of the focal length to three times it is filled.
    """
    height, width = image.shape[:2]
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    # OpenCV's pixels have whole numbers at their middles.
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)

    def maps(zoom: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        x, y = _brown((u - cx) / (zoom * fx), (v - cy) / (zoom * fy), distortion)
        return (x * fx + cx - 0.5).astype(np.float32), (y * fy + cy - 0.5).astype(np.float32)

    def filled(zoom: float) -> bool:
        across, down = maps(zoom)
        inside = (across >= 0) & (across <= width - 1) & (down >= 0) & (down <= height - 1)
        # Where the lens turns rays back, coordinates fall again.
        return bool(inside.all() and (np.diff(across, axis=1) > 0).all() and (np.diff(down, axis=0) > 0).all())

    zooms = np.geomspace(0.25, 3, 85)  # steps of 3%
    fits = next((zoom for zoom in zooms if filled(zoom)), None)
    if fits is None:
        return None
    chosen = maps(fits)
    drawn = cv2.remap(image, *chosen, interpolation=cv2.INTER_LINEAR)
    if mask is not None:
        stored = mask.numpy().astype(np.uint8).reshape(height, width) * 255
        mask = torch.from_numpy(cv2.remap(stored, *chosen, interpolation=cv2.INTER_LINEAR)).bool()[..., None]
    new = np.array([[fits * fx, 0, cx], [0, fits * fy, cy], [0, 0, 1]], dtype=np.float32)
    return new, drawn, mask


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
