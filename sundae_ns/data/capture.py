"""Checks of a ``transforms.json`` before nerfstudio parses it, which raises assertions or trains on NaN."""

from __future__ import annotations

import json
import math
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.data.lenses import DISTORTION, FISHEYE624, INTRINSICS, REMEDY, kind_of_model, lens_of, with_focal_lengths

_MAX_SIDE, _MOST_BYTES = 65535, 32_000_000  # pixels: JPEG's limit; of a file, as 30,000 images have
_LARGEST = 1e12  # its square must stay in the range of float32


def finite(value: Any, name: str, where: str, *, positive: bool = False) -> float:
    """``value`` as a float; ``DataError`` if it is no number, not finite, too large, or not positive if asked."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DataError(f"{where}: {name} is {value!r:.80}; it must be a number")
    if not abs(value) <= _LARGEST:
        raise DataError(f"{where}: {name} is {value!r:.80}; it must be finite and at most {_LARGEST:g}")
    if positive and not value > 1e-6:
        raise DataError(f"{where}: {name} is {value!r:.80}; it must be positive")
    return float(value)


def side(value: Any, name: str, where: str) -> int:
    """``value`` as the side of an image in pixels; ``DataError`` unless it is a whole number from 1 to 65,535."""
    if (length := finite(value, name, where)) != int(length) or not 1 <= length <= _MAX_SIDE:
        raise DataError(f"{where}: {name} is {value!r:.80}; it must be a whole number of pixels, at most {_MAX_SIDE}")
    return int(length)


def matrix(value: Any, rows: Sequence[int], name: str, where: str) -> np.ndarray:
    """``value`` as a finite, regular float64 matrix ``[R, 4]`` with R one of ``rows``; ``DataError`` if it is none."""
    table = np.array(value, object)  # of whatever the file holds
    if table.shape[1:] != (4,) or len(table) not in rows:
        raise DataError(f"{where}: {name} must have {' or '.join(map(str, rows))} rows of 4 numbers; correct the file")
    for entry in table.flat:
        finite(entry, name, where)
    array = table.astype(np.float64)
    if abs(np.linalg.det(array[:3, :3])) < 1e-9:
        raise DataError(f"{where}: {name} is singular, so it is not a camera pose; remove this view")
    return array


def rigid(pose: np.ndarray, where: str) -> np.ndarray:
    """A camera pose ``[3 or 4, 4]`` without a scale in its rotation; ``DataError`` if its axes are no rotation."""
    if np.abs(pose[3:, :3]).max(initial=0) > 1e-6:
        raise DataError(f"{where}: the last row of its matrix is not 0 0 0 1; exchange rows and columns")
    axes = pose[:3, :3]
    if (scale := float(np.cbrt(np.linalg.det(axes)))) < 0 or np.abs(axes.T @ axes / scale**2 - np.eye(3)).max() > 0.1:
        raise DataError(f"{where}: its matrix is no camera pose, as the first three columns are not a rotation")
    return pose if abs(scale - 1) <= 1e-3 else np.hstack([pose[:, :3] / scale, pose[:, 3:]])  # rounded ones stay


def read_json(path: Path, *, slashes: bool = True, remedy: str = "write it again") -> dict[str, Any]:
    """The JSON object of a file, with ``slashes`` in Windows paths; ``DataError`` if it cannot be read or is none."""
    with reading(path, "JSON", remedy=remedy), regular(path).open("rb") as file:
        text = file.read(_MOST_BYTES + 1)
        if len(text) > _MOST_BYTES or sum(map(text.count, b"[{:")) > 2_000_000:
            raise DataError(f"{path} has more than 32 MB, or two million lists and entries; split it")
        content = json.loads(text.replace(rb"\\", b"/" if slashes else rb"\\"))
    if not isinstance(content, dict):
        raise DataError(f"{path} does not hold a JSON object; give the transforms.json of a capture")
    return content


def check_transforms(path: Path, *, splits: Sequence[str] = ()) -> dict[str, Any]:
    """Contents of a ``transforms.json``, after a check with its lists of ``splits``; ``DataError`` names the entry."""
    meta = read_json(path)
    frames = meta["frames"] if isinstance(meta.get("frames"), list) else []
    if (count := len(frames)) < 2:
        raise DataError(f"{path} lists {count} image{'s' * (count != 1)}; training needs 2 or more, with their poses")
    _check_values(meta, path.name)
    meta = with_focal_lengths(meta, path.parent)
    kinds = set[str]()
    for index, frame in enumerate(frames):
        where = f"{path.name}, frame {index}"
        if not isinstance(frame, dict):
            raise DataError(f"{where}: it must be an object with file_path and transform_matrix")
        _path(frame.get("file_path"), "file_path", where)
        where += f" ({frame['file_path']!r:.80})"
        _check_values({"transform_matrix": None, **frame}, where)
        if missing := [key for key in INTRINSICS if key not in meta and key not in frame]:
            raise DataError(f"{where}: {', '.join(missing)} missing; give them in each frame, or for all at the top")
        kinds.add(lens_of(meta, frame, where).kind)
    for key in ("mask_path", "depth_file_path"):
        if (count := sum(key in frame for frame in frames)) not in (0, len(frames)):
            raise DataError(f"{path.name}: {count} of {len(frames)} frames have a {key}; give it in all or in none")
    if FISHEYE624 in kinds:  # nerfstudio makes the masks of such a lens, and reads it with no other kind
        if len(kinds) > 1:
            raise DataError(f"{path.name}: lenses {' and '.join(sorted(kinds))} in one capture; undistort the images")
        _radius(meta.get("fisheye_crop_radius"), "fisheye_crop_radius", path.name)
        if "mask_path" in frames[0]:
            raise DataError(f"{path.name}: nerfstudio makes the masks of a FISHEYE624 camera; remove mask_path")
    listed = [split for split in ("train", "val", "test") if f"{split}_filenames" in meta]
    known = {str(Path(frame["file_path"])) for frame in frames}
    for split in splits if listed else ():
        name = f"{split}_filenames"
        if not isinstance(files := meta.get(name), list) or not all(isinstance(file, str) for file in files):
            remedy = f"add {name} as a list of paths, or remove all such lists"
            raise DataError(f"{path.name} lists images for {', '.join(listed)}, but none for {split}; {remedy}")
        if lost := [file for file in files if str(Path(file)) not in known]:
            raise DataError(f"{path.name}: {name} has {lost[0]!r:.80}, which no frame has as file_path; correct it")
    return meta


def _check_values(entries: Mapping[str, Any], where: str) -> None:
    for key, check in _CHECKS.items():
        if key in entries:
            check(entries[key], key, where)


def _must(holds: Callable[[Any], object], requirement: str) -> Callable[[Any, str, str], None]:
    def check(value: Any, name: str, where: str) -> None:
        if not holds(value):
            raise DataError(f"{where}: {name} is {value!r:.80}; it must be {requirement}")

    return check


_path = _must(lambda value: isinstance(value, str) and value and "\0" not in value, "the path of a file")
_angle = _must(lambda value: type(value) in (int, float) and 0 < value < math.pi, "an angle in radians, below pi")
_numbers = _must(
    lambda value: isinstance(value, list) and all(type(n) in (int, float) and abs(n) <= _LARGEST for n in value),
    "a list of 4, 6 or 12 finite numbers",
)
_radius = _must(lambda px: isinstance(px, float) and 0 < px < math.inf, "a positive number with a decimal point")
_tiny = _must(lambda value: type(value) in (int, float) and abs(value) < 1e-3, f"0, or undistorted: {REMEDY}")
# The check of each entry of a file or of a frame, called with its value, its name and where it stands.
_CHECKS: dict[str, Callable[[Any, str, str], Any]] = {
    **dict.fromkeys(("w", "h"), side),
    **dict.fromkeys(("fl_x", "fl_y", "applied_scale"), partial(finite, positive=True)),
    **dict.fromkeys(("cx", "cy", *DISTORTION), finite),
    **dict.fromkeys(("k5", "k6", "s1", "s2", "sx1", "sy1", "b1", "b2", "skew"), _tiny),
    **dict.fromkeys(("camera_angle_x", "camera_angle_y"), _angle),
    **dict.fromkeys(("mask_path", "depth_file_path", "ply_file_path"), _path),
    "distortion_params": _numbers,
    "camera_model": lambda value, _, where: kind_of_model(value, where),
    "transform_matrix": lambda value, name, where: rigid(matrix(value, (4,), name, where), where),
    "applied_transform": lambda value, name, where: matrix(value, (3,), name, where),
    "orientation_override": _must(("pca", "up", "vertical", "none").__contains__, "pca, up, vertical or none"),
}


def check_first_image(path: Path, meta: Mapping[str, Any], factor: int) -> None:
    """Raise ``DataError`` unless the first image of a ``transforms.json`` is there at 1/factor of its size."""
    stated = {**meta, **meta["frames"][0]}
    image, small = path.parent / stated["file_path"], path.parent / f"images_{factor}"
    if factor == 1 or small.exists():
        image = image if factor == 1 else small / image.name
        if not image.exists():
            raise DataError(f"{image} does not exist{beside(image)}; correct file_path in {path.name}")
        return
    made = ", ".join(["1", *(entry.name[7:] for entry in entries(path.parent) if entry.name.startswith("images_"))])
    size = f"{int(stated['w']) // factor}x{int(stated['h']) // factor}!"
    make = f"`mkdir {small.name} && magick mogrify -path {small.name} -resize {size} images/*`"
    raise DataError(f"{small} does not exist; give another --downscale-factor ({made}), or make it with {make}")


def beside(path: Path) -> str:
    """A remark on a file of another case, suffix or Unicode form than a missing one: `` (there is x.PNG)``; or ""."""
    wanted = [unicodedata.normalize("NFC", name).lower() for name in (path.stem, path.name)]
    names = [entry.name for entry in entries(path.parent) if unicodedata.normalize("NFC", entry.stem).lower() in wanted]
    other = "" if path.name in names or not names else names[0]
    return other and f" (there is {other if other.isascii() else ascii(other)})"


def entries(folder: Path) -> list[Path]:
    """Contents of a folder in their order, at most 10,000; empty if there is no such folder."""
    return sorted(folder.glob("*"))[:10_000]
