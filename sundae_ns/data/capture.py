"""Checks of a capture before it is parsed: ``transforms.json`` and the headers of its images.

nerfstudio's parsers assume a well-formed capture; on any other they raise an assertion or train on NaN. These functions
read text and image headers, no pixels.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sundae_ns.data.beside import beside
from sundae_ns.data.lenses import (
    DISTORTION,
    FISHEYE624,
    INTRINSICS,
    kind_of_model,
    lens_of,
    size_of_first_image,
    with_focal_lengths,
)
from sundae_ns.errors import DataError, one_line, reading, regular

_MAX_SIDE = 65535
"""Longest side of an image, in pixels: JPEG's limit."""
_LARGEST = 1e12
"""Largest coordinate or focal length; its square must stay in the range of float32."""
_PIXELS_PER_BYTE = 4096
"""Pixels per byte that no image format reaches, even for one flat colour."""
_SMALL_IMAGE = 1 << 20
"""Images of up to this many pixels pass, for any size of the file."""
_CROOKED = 0.1
"""Error of lengths and of cosines above which three axes are no rotation."""
_ROUNDED = 1e-3
"""Error of the lengths of axes that is left as it is."""
_ORIENTATIONS = ("pca", "up", "vertical", "none")


def finite(value: Any, name: str, where: str, *, positive: bool = False) -> float:
    """``value`` as a float; ``DataError`` if it is no number, not finite, too large, or not positive if asked."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DataError(f"{where}: {name} is {_short(value)}; it must be a number")
    if not abs(value) <= _LARGEST:
        raise DataError(f"{where}: {name} is {_short(value)}; it must be finite and at most {_LARGEST:g}")
    if positive and not value > 1e-6:
        raise DataError(f"{where}: {name} is {_short(value)}; it must be positive")
    return float(value)


def side(value: Any, name: str, where: str) -> int:
    """``value`` as the side of an image in pixels; ``DataError`` unless it is a whole number from 1 to 65,535."""
    length = finite(value, name, where)
    if length != int(length) or not 1 <= length <= _MAX_SIDE:
        raise DataError(
            f"{where}: {name} is {_short(value)}; it must be a whole number of pixels from 1 to {_MAX_SIDE}"
        )
    return int(length)


def matrix(value: Any, rows: Sequence[int], name: str, where: str) -> np.ndarray:
    """``value`` as a float64 matrix ``[R, 4]``, with R one of ``rows``.

    Raises:
        DataError: it has another shape, an entry that is not finite, or is singular.
    """
    whole = isinstance(value, list) and len(value) in rows
    if not whole or not all(isinstance(row, list) and len(row) == 4 for row in value):
        raise DataError(f"{where}: {name} must have {' or '.join(map(str, rows))} rows of 4 numbers")
    for entry in chain(*value):
        finite(entry, name, where)
    array = np.array(value, dtype=np.float64)
    if abs(np.linalg.det(array[:3, :3])) < 1e-9:
        raise DataError(f"{where}: {name} is singular, so it is not a camera pose; remove this view")
    return array


def rigid(pose: np.ndarray, where: str) -> np.ndarray:
    """A camera pose ``[3 or 4, 4]`` whose rotation has no scale; programs that scale a scene may leave theirs in it.

    Raises:
        DataError: the axes of the camera differ in length, or are not at right angles.
    """
    axes = pose[:3, :3]
    scale = abs(float(np.linalg.det(axes))) ** (1 / 3)
    if np.abs(axes.T @ axes / scale**2 - np.eye(3)).max() > _CROOKED:
        raise DataError(f"{where}: transform_matrix is no camera pose, as its first three columns are not a rotation")
    if abs(scale - 1) <= _ROUNDED:
        return pose
    pose = pose.copy()
    pose[:3, :3] /= scale
    return pose


def read_bytes(path: Path) -> bytes:
    """Contents of a file; ``DataError`` if it cannot be read."""
    with reading(path, "a file"):
        return regular(path).read_bytes()


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object of a file; ``DataError`` if it cannot be read or holds none."""
    with reading(path, "JSON", mend="write it again"):
        content = json.loads(read_bytes(path))
    if not isinstance(content, dict):
        raise DataError(f"{path} does not hold a JSON object; give the transforms.json of a capture")
    return content


def check_transforms(path: Path, *, splits: Sequence[str] = ()) -> dict[str, Any]:
    """Check the ``transforms.json`` of a capture; returns its contents.

    Args:
        path: the file.
        splits: splits that will be read, such as ``"train"``; checked if the file lists images by split.

    Raises:
        DataError: names the first unusable entry, its frame, and what it must be.
    """
    meta = read_json(path)
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{path} lists no frames; a capture needs at least one image with its pose")
    _check_angles(meta, path.name)
    if "fl_x" not in meta:
        meta = with_focal_lengths(meta, size_of_first_image(meta, path.parent))
    shared = [name for name in INTRINSICS if name in meta]
    _check_camera(meta, shared, path.name)
    models = {kind_of_model(meta["camera_model"], path.name)} if "camera_model" in meta else set()
    extras: dict[str, int] = {"mask_path": 0, "depth_file_path": 0}
    names = set()
    for index, frame in enumerate(frames):
        where = f"{path.name}, frame {index}"
        if not isinstance(frame, dict):
            raise DataError(f"{where}: it must be an object with file_path and transform_matrix")
        name = _path(frame.get("file_path"), "file_path", where)
        names.add(name)
        where = f"{where} ({_short(name)})"
        missing = [key for key in INTRINSICS if key not in shared and key not in frame]
        if missing:
            raise DataError(f"{where}: {', '.join(missing)} missing; give them in each frame, or for all at the top")
        _check_camera(frame, [key for key in INTRINSICS if key in frame], where)
        if "camera_model" in frame:
            models.add(kind_of_model(frame["camera_model"], where))
        rigid(matrix(frame.get("transform_matrix"), (4,), "transform_matrix", where), where)
        for key in extras:
            if key in frame:
                _path(frame[key], key, where)
                extras[key] += 1
    for key, count in extras.items():
        if count not in (0, len(frames)):
            raise DataError(f"{path.name}: {count} of {len(frames)} frames have a {key}; give it in all or in none")
    if models == {FISHEYE624}:
        _check_round_lens(meta, extras["mask_path"] > 0, path.name)
    for index, frame in enumerate(frames):
        lens_of(meta, frame, f"{path.name}, frame {index} ({_short(frame['file_path'])})")
    _check_splits(meta, names, splits, path.name)
    _check_frame_of_capture(meta, path.name)
    return meta


def _check_camera(entry: Mapping[str, Any], keys: Collection[str], where: str) -> None:
    """Check the intrinsics ``keys`` of an entry, and its distortion."""
    for key in keys:
        if key in ("w", "h"):
            side(entry[key], key, where)
        else:
            finite(entry[key], key, where, positive=key.startswith("fl"))
    for key in DISTORTION:
        if key in entry:
            finite(entry[key], key, where)
    if "distortion_params" in entry:
        values = entry["distortion_params"]
        if not isinstance(values, list) or len(values) not in (4, 6, 12):
            raise DataError(f"{where}: distortion_params must be a list of 4, 6 or 12 numbers")
        for value in values:
            finite(value, "distortion_params", where)


def _check_angles(meta: Mapping[str, Any], where: str) -> None:
    for key in ("camera_angle_x", "camera_angle_y"):
        if key in meta and not 0 < finite(meta[key], key, where) < math.pi:
            raise DataError(f"{where}: {key} is {_short(meta[key])}; it must be an angle of view in radians, below pi")


def _check_round_lens(meta: Mapping[str, Any], masked: bool, where: str) -> None:
    """Check the entries from which nerfstudio makes the masks of a FISHEYE624 camera."""
    radius = meta.get("fisheye_crop_radius")
    if not isinstance(radius, float) or not 0 < radius < math.inf:
        raise DataError(
            f"{where}: fisheye_crop_radius is {_short(radius)}; a FISHEYE624 camera needs it, a positive number of "
            "pixels with a decimal point"
        )
    if masked:
        raise DataError(f"{where}: nerfstudio makes the masks of a FISHEYE624 camera; remove mask_path")


def _check_splits(meta: Mapping[str, Any], names: set[str], splits: Sequence[str], where: str) -> None:
    listed = [split for split in ("train", "val", "test") if f"{split}_filenames" in meta]
    for split in splits if listed else ():
        files = meta.get(f"{split}_filenames")
        if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
            raise DataError(
                f"{where} lists images for {', '.join(listed)}, but none for {split}; add {split}_filenames as a list "
                "of paths, or remove all such lists"
            )
        known = {str(Path(name)) for name in names}
        unknown = [file for file in files if str(Path(file)) not in known]
        if unknown:
            raise DataError(
                f"{where}: {split}_filenames has {_short(unknown[0])}, which no frame has as its file_path; correct it"
            )


def _check_frame_of_capture(meta: Mapping[str, Any], where: str) -> None:
    if "applied_transform" in meta:
        matrix(meta["applied_transform"], (3,), "applied_transform", where)
    if "applied_scale" in meta:
        finite(meta["applied_scale"], "applied_scale", where, positive=True)
    if meta.get("orientation_override", "up") not in _ORIENTATIONS:
        raise DataError(
            f"{where}: orientation_override is {_short(meta['orientation_override'])}; "
            f"use one of {', '.join(_ORIENTATIONS)}"
        )
    if "ply_file_path" in meta:
        _path(meta["ply_file_path"], "ply_file_path", where)


def _path(value: Any, name: str, where: str) -> str:
    if not isinstance(value, str) or not value or "\0" in value:
        raise DataError(f"{where}: {name} is {_short(value)}; it must be the path of a file")
    return value


def check_image(path: Path, *, mask: bool = False) -> tuple[int, int]:
    """Width and height in pixels of an image, after a check by its header that training can use it.

    A ``mask`` has one channel, a photograph 8 bits per channel.

    Raises:
        DataError: the file is missing, not an image, of another pixel type, or too short for its size in pixels.
    """
    try:
        with Image.open(regular(path)) as image:
            size, mode = image.size, image.mode
        length = path.stat().st_size
    except OSError as error:
        reason = error.strerror or ("it is not an image" if isinstance(error, Image.UnidentifiedImageError) else error)
        raise DataError(f"{path} cannot be read ({reason}){beside(path)}; repair it or remove the view") from error
    except Exception as error:  # decoders raise many types; each means the same to the user
        raise DataError(f"{path} is not a complete image ({one_line(error)}); repair it or remove the view") from error
    modes = ("1", "L") if mask else ("L", "RGB", "RGBA")
    if mode not in modes:
        wanted = "one channel of 8 bits" if mask else "RGB, RGBA or grey with 8 bits per channel"
        raise DataError(f"{path} has pixels of type {mode}; save it with {wanted}")
    if size[0] * size[1] > max(_PIXELS_PER_BYTE * length, _SMALL_IMAGE):
        raise DataError(f"{path} claims {size[0]} x {size[1]} px in {length:,} bytes; it is incomplete, save it again")
    return size


def undecodable(path: Path, error: Exception) -> DataError:
    """The error for an image with a valid header and broken pixels."""
    return DataError(f"{path} cannot be decoded ({one_line(error)}); repair it or remove the view")


def _short(value: Any) -> str:
    """A value as one line of at most 80 characters, for an error message."""
    shown = repr(value)
    return shown if len(shown) <= 80 else shown[:77] + "..."
