"""Checks of a capture before it is parsed: ``transforms.json`` and the headers of its images.

nerfstudio's parsers assume a well-formed capture; on any other they raise an assertion or train on NaN. These functions
read text and image headers, no pixels.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sundae_ns.core.errors import DataError, one_line, reading, regular
from sundae_ns.data.lenses import DISTORTION, FISHEYE624, INTRINSICS, kind_of_model, lens_of, with_focal_lengths

_MAX_SIDE = 65535  # pixels: JPEG's limit
_LARGEST = 1e12  # its square must stay in the range of float32


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
    """``value`` as a finite, regular float64 matrix ``[R, 4]`` with R one of ``rows``; ``DataError`` if it is none."""
    listed = isinstance(value, list) and len(value) in rows
    if not listed or not all(isinstance(row, list) and len(row) == 4 for row in value):
        raise DataError(f"{where}: {name} must have {' or '.join(map(str, rows))} rows of 4 numbers")
    for entry in chain(*value):
        finite(entry, name, where)
    array = np.array(value, dtype=np.float64)
    if abs(np.linalg.det(array[:3, :3])) < 1e-9:
        raise DataError(f"{where}: {name} is singular, so it is not a camera pose; remove this view")
    return array


def rigid(pose: np.ndarray, where: str) -> np.ndarray:
    """A camera pose ``[3 or 4, 4]`` without the scale that programs may leave in its rotation.

    Raises:
        DataError: the axes of the camera differ in length, or are not at right angles.
    """
    axes = pose[:3, :3]
    scale = abs(float(np.linalg.det(axes))) ** (1 / 3)
    if np.abs(axes.T @ axes / scale**2 - np.eye(3)).max() > 0.1:
        raise DataError(f"{where}: transform_matrix is no camera pose, as its first three columns are not a rotation")
    if abs(scale - 1) <= 1e-3:  # rounded numbers
        return pose
    pose = pose.copy()
    pose[:3, :3] /= scale
    return pose


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object of a file; ``DataError`` if it cannot be read or holds none."""
    with reading(path, "JSON", remedy="write it again"):
        content = json.loads(regular(path).read_bytes())
    if not isinstance(content, dict):
        raise DataError(f"{path} does not hold a JSON object; give the transforms.json of a capture")
    return content


def check_transforms(path: Path, *, splits: Sequence[str] = ()) -> dict[str, Any]:
    """Check the ``transforms.json`` of a capture, and its lists of ``splits`` if it has any; returns its contents.

    Raises:
        DataError: names the first unusable entry, its frame, and what it must be.
    """
    meta = read_json(path)
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{path} lists no frames; a capture needs at least one image with its pose")
    _check_values(meta, path.name)
    meta = with_focal_lengths(meta, path.parent)
    kinds: Counter[str] = Counter()
    for index, frame in enumerate(frames):
        where = f"{path.name}, frame {index}"
        if not isinstance(frame, dict):
            raise DataError(f"{where}: it must be an object with file_path and transform_matrix")
        _path(frame.get("file_path"), "file_path", where)
        where += f" ({_short(frame['file_path'])})"
        _check_values({"transform_matrix": None, **frame}, where)
        missing = [key for key in INTRINSICS if key not in meta and key not in frame]
        if missing:
            raise DataError(f"{where}: {', '.join(missing)} missing; give them in each frame, or for all at the top")
        kinds[lens_of(meta, frame, where).kind] += 1
    for key in ("mask_path", "depth_file_path"):
        count = sum(key in frame for frame in frames)
        if count not in (0, len(frames)):
            raise DataError(f"{path.name}: {count} of {len(frames)} frames have a {key}; give it in all or in none")
    if FISHEYE624 in kinds:
        # nerfstudio makes the masks of such a lens, and reads it with no other kind.
        radius = meta.get("fisheye_crop_radius")
        counts = ", ".join(f"{count} images with {kind}" for kind, count in sorted(kinds.items()))
        for wrong, remedy in (
            (len(kinds) > 1, f"FISHEYE624 cannot be mixed with other lenses ({counts}); undistort the images first"),
            (
                not isinstance(radius, float) or not 0 < radius < math.inf,
                f"fisheye_crop_radius is {_short(radius)}; a FISHEYE624 camera needs it, a positive number of pixels "
                "with a decimal point",
            ),
            ("mask_path" in frames[0], "nerfstudio makes the masks of a FISHEYE624 camera; remove mask_path"),
        ):
            if wrong:
                raise DataError(f"{path.name}: {remedy}")
    _check_splits(meta, splits, path.name)
    return meta


def _check_values(entries: Mapping[str, Any], where: str) -> None:
    for key, check in _CHECKS.items():
        if key in entries:
            check(entries[key], key, where)


def _must(holds: Callable[[Any], object], requirement: str) -> Callable[[Any, str, str], None]:
    def check(value: Any, name: str, where: str) -> None:
        if not holds(value):
            raise DataError(f"{where}: {name} is {_short(value)}; it must be {requirement}")

    return check


def _distortion(value: Any, name: str, where: str) -> None:
    if not isinstance(value, list) or len(value) not in (4, 6, 12):
        raise DataError(f"{where}: {name} must be a list of 4, 6 or 12 numbers")
    for number in value:
        finite(number, name, where)


_path = _must(lambda value: isinstance(value, str) and value and "\0" not in value, "the path of a file")
_angle = _must(
    lambda value: type(value) in (int, float) and 0 < value < math.pi, "an angle of view in radians, below pi"
)
_CHECKS: dict[str, Callable[[Any, str, str], Any]] = {
    **dict.fromkeys(("w", "h"), side),
    **dict.fromkeys(("fl_x", "fl_y", "applied_scale"), partial(finite, positive=True)),
    **dict.fromkeys(("cx", "cy", *DISTORTION), finite),
    **dict.fromkeys(("camera_angle_x", "camera_angle_y"), _angle),
    **dict.fromkeys(("mask_path", "depth_file_path", "ply_file_path"), _path),
    "distortion_params": _distortion,
    "camera_model": lambda value, _, where: kind_of_model(value, where),
    "transform_matrix": lambda value, name, where: rigid(matrix(value, (4,), name, where), where),
    "applied_transform": lambda value, name, where: matrix(value, (3,), name, where),
    "orientation_override": _must(
        lambda value: value in ("pca", "up", "vertical", "none"), "pca, up, vertical or none"
    ),
}
"""The check of each entry of a file or of a frame, called with its value, its name and where it stands."""


def _check_splits(meta: Mapping[str, Any], splits: Sequence[str], where: str) -> None:
    listed = [split for split in ("train", "val", "test") if f"{split}_filenames" in meta]
    known = {str(Path(frame["file_path"])) for frame in meta["frames"]}
    for split in splits if listed else ():
        name = f"{split}_filenames"
        files = meta.get(name)
        if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
            remedy = f"add {name} as a list of paths, or remove all such lists"
            raise DataError(f"{where} lists images for {', '.join(listed)}, but none for {split}; {remedy}")
        for file in files:
            if str(Path(file)) not in known:
                raise DataError(f"{where}: {name} has {_short(file)}, which no frame has as its file_path; correct it")


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
    # No format stores 4,096 pixels in a byte, even of one flat colour.
    if size[0] * size[1] > max(4096 * length, 1 << 20):
        raise DataError(f"{path} claims {size[0]} x {size[1]} px in {length:,} bytes; it is incomplete, save it again")
    return size


def undecodable(path: Path, error: Exception) -> DataError:
    """The error for an image with a valid header and broken pixels."""
    return DataError(f"{path} cannot be decoded ({one_line(error)}); repair it or remove the view")


def beside(path: Path) -> str:
    """A remark on a file with another case or suffix than a missing one: `` (there is x.PNG)``; empty without one."""
    wanted = (path.stem.lower(), path.name.lower())
    names = [entry.name for entry in entries(path.parent) if entry.stem.lower() in wanted]
    return "" if path.name in names or not names else f" (there is {names[0]})"


def entries(folder: Path) -> list[Path]:
    """Contents of a folder in their order, at most 10,000; empty if there is no such folder."""
    try:
        return sorted(folder.iterdir())[:10_000]
    except OSError:
        return []


def _short(value: Any) -> str:
    """A value as one line of at most 80 characters, for an error message."""
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
