"""Lenses of a ``transforms.json`` or a COLMAP model; projections that cannot be undistorted are refused."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from sundae_ns.core.errors import DataError

KINDS = PERSPECTIVE, FISHEYE, FISHEYE624 = "OPENCV", "OPENCV_FISHEYE", "FISHEYE624"  # those that nerfstudio undistorts
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # in the order of nerfstudio's distortion_params
_NO_LENSES = {"FOV": 7, "RAD_TAN_THIN_PRISM_FISHEYE": 11, "SIMPLE_DIVISION": 12, "DIVISION": 13, "EUCM": 16}
COLMAP_LENSES: dict[str, tuple[int, str | None, str, str]] = {
    "SIMPLE_PINHOLE": (0, PERSPECTIVE, "f cx cy", ""),
    "PINHOLE": (1, PERSPECTIVE, "fx fy cx cy", ""),
    "SIMPLE_RADIAL": (2, PERSPECTIVE, "f cx cy k1", ""),
    "RADIAL": (3, PERSPECTIVE, "f cx cy k1 k2", ""),
    "OPENCV": (4, PERSPECTIVE, "fx fy cx cy k1 k2 p1 p2", ""),
    "OPENCV_FISHEYE": (5, FISHEYE, "fx fy cx cy k1 k2 k3 k4", ""),
    "FULL_OPENCV": (6, PERSPECTIVE, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": (8, FISHEYE, "f cx cy k1", ""),
    "RADIAL_FISHEYE": (9, FISHEYE, "f cx cy k1 k2", ""),
    "THIN_PRISM_FISHEYE": (10, FISHEYE, "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1", "p1 p2 sx1 sy1"),
    "SIMPLE_FISHEYE": (14, FISHEYE, "f cx cy", ""),
    "FISHEYE": (15, FISHEYE, "fx fy cx cy", ""),
    **{name: (number, None, "", "") for name, number in {**_NO_LENSES, "EQUIRECTANGULAR": 17}.items()},
}
"""COLMAP's camera models: number, kind (None if there is none), parameters in their order, and those that must be 0."""
_KINDS = {name: kind for name, (_, kind, _, z) in COLMAP_LENSES.items() if kind and not z} | {FISHEYE624: FISHEYE624}
REMEDY = "make undistorted images with `colmap image_undistorter`, or calibrate the capture with OPENCV"
_REMEDIES = {
    "EQUIRECTANGULAR": "the images are panoramas: cut them into perspective images with `ns-process-data images "
    "--camera-type equirectangular --data PANORAMAS --output-dir CAPTURE`, which finds new poses",
    "CYLINDRICAL": "the image is a panorama: leave it out, or take photos from several places",
    **dict.fromkeys(("OMNIDIRECTIONALSTEREO", "VR180"), "the images show two eyes: cut cube faces of one, with poses"),
    "ORTHOPHOTO": "an orthophoto has no focal length: train on the photos that it was made of",
}
"""Projections that no perspective image shows whole, by the start of their names, and the remedy."""


class Lens(NamedTuple):
    """A kind of lens, and its distortion as :data:`DISTORTION`, or the 12 numbers of :data:`FISHEYE624`."""

    kind: str
    distortion: tuple[float, ...]


def kind_of_model(model: Any, where: str) -> str:
    """The kind of lens of a ``camera_model``; ``DataError`` with the remedy for other projections."""
    if isinstance(model, str) and model in _KINDS:
        return _KINDS[model]
    raise _refusal(str(model), where, f"camera_model is {model!r:.80}; use one of {', '.join(_KINDS)}")


def _refusal(model: str, where: str, otherwise: str = "") -> DataError:
    """The error for a projection, with a remedy of its own if there is one."""
    remedy = next((remedy for start, remedy in _REMEDIES.items() if model.startswith(start)), None)
    what = f"camera model {model} is no lens that perspective images can be made of; {remedy}"
    otherwise = otherwise or f"nerfstudio does not support camera model {model}; {REMEDY}"
    return DataError(f"{where}: {what if remedy else otherwise}")


def kind_of_frame(stated: Mapping[str, Any], where: str) -> str:
    """The kind of lens of a frame by its entries, in instant-ngp's files flags; errors as :func:`kind_of_model`."""
    flags = {"is_fisheye": "OPENCV_FISHEYE", "equirectangular": "EQUIRECTANGULAR", "latlong": "EQUIRECTANGULAR"}
    default = next((model for flag, model in flags.items() if stated.get(flag) is True), "OPENCV")
    return kind_of_model(stated.get("camera_model", default), where)


def lens_of(meta: Mapping[str, Any], frame: Mapping[str, Any], where: str) -> Lens:
    """The lens of a frame, whose entries count before those of the file; ``DataError`` if nothing undistorts it."""
    stated = {**meta, **frame}
    kind = kind_of_frame(stated, where)
    of_frame = "distortion_params" not in frame and any(key in frame for key in DISTORTION)
    if (values := None if of_frame else stated.get("distortion_params")) is None:
        values = [stated.get(key, 0.0) for key in DISTORTION] if kind != FISHEYE624 else []
    if kind != FISHEYE624 and len(values) == 4:
        if kind != FISHEYE and any(values[2:]):
            raise DataError(f"{where}: four distortion_params may be k1, k2, p1, p2 or k1 to k4; give them by name")
        values = [*values, 0.0, 0.0]
    count, names = (12, "") if kind == FISHEYE624 else (6, f" ({', '.join(DISTORTION)})")
    if len(values) != count:
        raise DataError(f"{where}: {kind} needs distortion_params of {count} numbers{names}, not {len(values)}")
    return Lens(kind, tuple(map(float, values)))


def colmap_lens(model: str, params: Sequence[float], where: str) -> tuple[tuple[float, float, float, float], Lens]:
    """Intrinsics ``fx, fy, cx, cy`` in pixels and the lens of a COLMAP camera; ``DataError`` if it is unsupported."""
    _, kind, names, zeros = COLMAP_LENSES[model]
    stated = dict(zip(names.split(), map(float, params), strict=True))
    if kind is None or any(stated[name] for name in zeros.split()):
        raise _refusal(model, where)
    fx, fy = stated.get("fx", stated.get("f", 0.0)), stated.get("fy", stated.get("f", 0.0))
    return (fx, fy, stated["cx"], stated["cy"]), Lens(kind, tuple(stated.get(key, 0.0) for key in DISTORTION))


def colmap_model(model: int | str, where: str) -> str:
    """Name of a COLMAP camera model by its number or name; ``DataError`` with the remedy if it is unsupported."""
    for name, (number, kind, _, _) in COLMAP_LENSES.items():
        if model in (name, number):
            if kind is None:
                raise _refusal(name, where)
            return name
    raise DataError(f"{where}: camera model {model} is not known here; calibrate the capture with OPENCV")


def with_focal_lengths(meta: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A ``transforms.json`` that states angles of view, as Blender and instant-ngp do, with focal lengths in pixels."""
    angles: list[Any] = [meta.get(f"camera_angle_{axis}") for axis in "xy"]
    known = [type(angle) in (int, float) and 0 < angle < math.pi for angle in angles]
    entries = [meta, *(meta["frames"] if isinstance(meta.get("frames"), list) else [])]
    if not known[0] or any(isinstance(entry, dict) and "fl_x" in entry for entry in entries):
        return meta
    size: Any = (None, None)
    for suffix in ("", ".png"):  # Blender leaves it out
        with suppress(Exception), Image.open(f"{folder / meta['frames'][0]['file_path']}{suffix}") as image:
            size = image.size
    width, height = meta.get("w", size[0]), meta.get("h", size[1])
    if not isinstance(width, (int, float)) or not isinstance(height, (int, float)):
        return meta
    focal_x = width / 2 / math.tan(angles[0] / 2)
    focal_y = height / 2 / math.tan(angles[1] / 2) if known[1] else focal_x
    return {"w": width, "h": height, "cx": width / 2, "cy": height / 2, **meta, "fl_x": focal_x, "fl_y": focal_y}
