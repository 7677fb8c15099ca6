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

from sundae_ns.core.errors import DataError, one_line

Result = tuple[NDArray[Any], NDArray[Any], Any]  # Intrinsics [3, 3], image [H, W, C] and mask


def undistorting(paths: Sequence[Path]) -> Callable[..., Result]:
    """A function in place of nerfstudio's that undistorts one image, for images with these paths.

    It raises ``DataError`` for a distortion that no image can have.
    """

    def undistort(camera: Any, distortion_params: Any, data: Any, image: Any, K: Any) -> Result:
        intrinsics, mask, kind = K.copy(), data.get("mask"), int(camera.camera_type)
        result, cause = None, "has a distortion that leaves no image"
        if kind == CameraType.PERSPECTIVE.value and distortion_params[3]:
            result = _of_brown(intrinsics, distortion_params, image, mask)
        else:
            try:
                stock = full_images_datamanager._undistort_image(camera, distortion_params, data, image, K)
                ratio = float(stock[0][0, 0]) / max(stock[1].shape[1], 1)
                # A view of more than 157 degrees (a ratio of 0.1) shows a smear.
                if np.isfinite(stock[0]).all() and 0.1 <= ratio <= 1000 and (stock[1].any() or not image.any()):
                    result = stock
                elif kind == CameraType.FISHEYE.value and _is_lens(distortion_params, intrinsics, image):
                    result = _middle(intrinsics, distortion_params, image, mask)
            except (AssertionError, LookupError, TypeError, ValueError, cv2.error) as error:
                cause = f"cannot be undistorted ({one_line(error)})"
        if result is None:
            values = ", ".join(f"{float(value):.3g}" for value in distortion_params)
            raise DataError(
                f"{paths[int(data['image_idx'])].name} {cause}; check its k1 ... p2 ({values}), which are of "
                "coordinates in focal lengths, not in pixels"
            )
        return result

    return undistort


def _of_brown(K: NDArray[Any], distortion: Any, image: NDArray[Any], mask: Any) -> Result | None:
    """The largest perspective image that a photo fills, by all four radial coefficients; OpenCV has three of them.

    None if no image of a quarter of the focal length to three times it is filled.
    """
    height, width = image.shape[:2]
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    k1, k2, k3, k4, p1, p2 = map(float, distortion)
    # OpenCV's pixels have whole numbers at their middles.
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for zoom in np.geomspace(0.25, 3, 85):  # steps of 3%
        x, y = (u - cx) / (zoom * fx), (v - cy) / (zoom * fy)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        across = (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) * fx + cx - 0.5
        down = (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) * fy + cy - 0.5
        maps = across.astype(np.float32), down.astype(np.float32)
        inside = (maps[0] >= 0) & (maps[0] <= width - 1) & (maps[1] >= 0) & (maps[1] <= height - 1)
        # Where the lens turns rays back, coordinates fall again.
        if inside.all() and (np.diff(maps[0], axis=1) > 0).all() and (np.diff(maps[1], axis=0) > 0).all():
            new = np.array([[zoom * fx, 0, cx], [0, zoom * fy, cy], [0, 0, 1]], dtype=np.float32)
            image = cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR)
            mask = None if mask is None else torch.from_numpy(_remapped(mask, image.shape, maps)).bool()[..., None]
            return new, image, mask
    return None


def _remapped(mask: Any, shape: tuple[int, ...], maps: tuple[NDArray[Any], NDArray[Any]]) -> NDArray[np.uint8]:
    """A mask ``[H, W, 1]`` at other pixels, from 0 to 255."""
    stored = mask.numpy().astype(np.uint8).reshape(shape[:2]) * 255
    return np.asarray(cv2.remap(stored, *maps, interpolation=cv2.INTER_LINEAR))


def _is_lens(distortion: Any, K: NDArray[Any], image: NDArray[Any]) -> bool:
    """Whether rays at larger angles lie farther out, up to the edges of a fisheye photo or to 90 degrees."""
    theta = np.linspace(0, np.pi / 2, 500)
    radius = theta * (1 + sum(float(k) * theta ** (2 * i + 2) for i, k in enumerate(distortion[:4])))
    outside = radius >= min(image.shape[1] / 2 / K[0, 0], image.shape[0] / 2 / K[1, 1])
    last = int(np.argmax(outside)) if outside.any() else len(theta) - 1
    return bool((np.diff(radius[: last + 1]) > 0).all())


def _middle(K: NDArray[Any], distortion: Any, image: NDArray[Any], mask: Any) -> Result:
    """The perspective image of the middle of a fisheye photo, to 60 degrees at the middles of its edges."""
    height, width = image.shape[:2]
    # OpenCV's pixels have whole numbers at their middles.
    old = K.astype(np.float64)
    old[:2, 2] -= 0.5
    k = np.array(distortion[:4], dtype=np.float64)
    focal = max(width, height) / 2 / np.tan(np.radians(60))
    new = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    maps = cv2.fisheye.initUndistortRectifyMap(old, k, np.eye(3), new, (width, height), cv2.CV_32FC1)
    valid = (maps[0] > -0.5) & (maps[0] < width - 0.5) & (maps[1] > -0.5) & (maps[1] < height - 0.5)
    if mask is not None:
        valid &= _remapped(mask, image.shape, maps) > 127
    image = cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR)
    new[:2, 2] += 0.5
    mask = None if mask is None and valid.all() else torch.from_numpy(valid)[..., None]
    return new.astype(np.float32), image, mask
