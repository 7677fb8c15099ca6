"""Lenses: what a ``transforms.json`` or a COLMAP model states of a camera, and which projections can be trained on.

The rasteriser draws perspective images. A perspective or fisheye lens is undistorted before training; any other
projection has no perspective image of the whole picture, so it is refused with the way to make some.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sundae_ns.errors import DataError

PERSPECTIVE, FISHEYE, FISHEYE624 = "OPENCV", "OPENCV_FISHEYE", "FISHEYE624"
"""Names of the three kinds of lenses that nerfstudio undistorts."""
INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Distortion of a ``transforms.json``, in the order of nerfstudio's ``distortion_params``."""

_KINDS = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), PERSPECTIVE),
    **dict.fromkeys(
        ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"), FISHEYE
    ),
    "FISHEYE624": FISHEYE624,
}
_CUT = (
    "cut them into perspective images with `ns-process-data images --camera-type equirectangular --data PANORAMAS "
    "--output-dir CAPTURE`, which finds new poses"
)
_EYES = "render or cut perspective images (cube faces) of one eye, each with its own pose"
_REFUSED = {
    "EQUIRECTANGULAR": f"the images are panoramas: {_CUT}",
    "OMNIDIRECTIONALSTEREO": f"the images are stereo panoramas: {_EYES}",
    "VR180": f"the images are half panoramas of stereo: {_EYES}",
    "ORTHOPHOTO": "an orthophoto has no focal length: train on the photos that it was made of",
}
COLMAP_LENSES: dict[str, tuple[int, str]] = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "FOV": (7, "fx fy cx cy omega"),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": (10, "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
    "SIMPLE_DIVISION": (12, "f cx cy k"),
    "DIVISION": (13, "fx fy cx cy k"),
    "SIMPLE_FISHEYE": (14, "f cx cy"),
    "FISHEYE": (15, "fx fy cx cy"),
    "EUCM": (16, "fx fy cx cy alpha beta"),
    "EQUIRECTANGULAR": (17, "w h"),
}
"""COLMAP's camera models: number, and parameters in their order."""
_SPECIAL_CASES = {"FULL_OPENCV": (PERSPECTIVE, ("k4", "k5", "k6")), "THIN_PRISM_FISHEYE": (FISHEYE, ("p1", "p2"))}
"""Models that equal one of nerfstudio's kinds where some parameters are zero."""


class Lens(NamedTuple):
    """A kind of lens and its distortion."""

    kind: str
    """:data:`PERSPECTIVE`, :data:`FISHEYE` or :data:`FISHEYE624`."""
    distortion: tuple[float, ...]
    """As :data:`DISTORTION`; the 12 numbers of :data:`FISHEYE624` in nerfstudio's order."""


def kind_of_model(model: Any, where: str) -> str:
    """The kind of lens of a ``camera_model``; ``DataError`` with the way out for other projections."""
    if isinstance(model, str) and model in _KINDS:
        return _KINDS[model]
    help_ = next((text for name, text in _REFUSED.items() if isinstance(model, str) and model.startswith(name)), None)
    if help_ is not None:
        raise DataError(f"{where}: camera_model {model} is no lens that perspective images can be made of; {help_}")
    shown = repr(model)[:80]
    raise DataError(f"{where}: camera_model is {shown}; use one of {', '.join(_KINDS)}")


def kind_of_frame(stated: Mapping[str, Any], where: str) -> str:
    """The kind of lens of a frame, from its entries over those of its file; errors as :func:`kind_of_model`."""
    # instant-ngp's files have flags in place of a model.
    flags = {"is_fisheye": "OPENCV_FISHEYE", "equirectangular": "EQUIRECTANGULAR", "latlong": "EQUIRECTANGULAR"}
    default = next((model for flag, model in flags.items() if stated.get(flag) is True), "OPENCV")
    return kind_of_model(stated.get("camera_model", default), where)


def lens_of(meta: Mapping[str, Any], frame: Mapping[str, Any], where: str) -> Lens:
    """The lens of a frame of a ``transforms.json``: what the frame states, and for the rest what the file states.

    Raises:
        DataError: its projection or its distortion cannot be undistorted.
    """
    stated = {**meta, **frame}
    kind = kind_of_frame(stated, where)
    own = "distortion_params" in frame or not any(key in frame for key in DISTORTION)
    values = stated.get("distortion_params") if own else None
    if values is None:
        values = [float(stated.get(key, 0.0)) for key in DISTORTION] if kind != FISHEYE624 else []
    return Lens(kind, _in_order(kind, tuple(map(float, values)), where))


def _in_order(kind: str, values: tuple[float, ...], where: str) -> tuple[float, ...]:
    """Distortion with all of its numbers, checked."""
    if kind == FISHEYE624:
        if len(values) != 12:
            raise DataError(f"{where}: a FISHEYE624 camera needs distortion_params of 12 numbers, not {len(values)}")
        return values
    if len(values) == 4 and (kind == FISHEYE or not any(values[2:])):
        values += (0.0, 0.0)
    elif len(values) == 4:
        raise DataError(
            f"{where}: four distortion_params may be k1, k2, p1, p2 or k1, k2, k3, k4; give them by these names instead"
        )
    if len(values) != 6:
        raise DataError(f"{where}: {kind} needs distortion_params of 6 numbers (k1, k2, k3, k4, p1, p2)")
    return values


def with_focal_lengths(meta: Mapping[str, Any], size: tuple[int, int] | None) -> dict[str, Any]:
    """A ``transforms.json`` that states angles of view, as Blender and instant-ngp do, with focal lengths in pixels.

    Args:
        meta: the file; one that states ``fl_x`` stays as it is.
        size: width and height of an image, for a file that states neither.
    """
    angle: Any = meta.get("camera_angle_x")
    frames = meta.get("frames")
    known = "fl_x" in meta or (isinstance(frames, list) and any("fl_x" in f for f in frames if isinstance(f, dict)))
    if known or not _is_angle(angle):
        return dict(meta)
    made = dict(meta)
    if size is not None:
        made.setdefault("w", size[0])
        made.setdefault("h", size[1])
    if not all(isinstance(made.get(key), (int, float)) for key in ("w", "h")):
        return made
    made["fl_x"] = made["w"] / 2 / math.tan(angle / 2)
    upright: Any = meta.get("camera_angle_y")
    made["fl_y"] = made["h"] / 2 / math.tan(upright / 2) if _is_angle(upright) else made["fl_x"]
    made.setdefault("cx", made["w"] / 2)
    made.setdefault("cy", made["h"] / 2)
    return made


def _is_angle(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < math.pi


def own_intrinsics(meta: Mapping[str, Any]) -> dict[str, Any]:
    """A ``transforms.json`` in which each frame states its own intrinsics, if any frame states some beside the file's.

    nerfstudio takes the file's wherever it has some. A file whose frames state none keeps its values.
    """
    distortion = (*DISTORTION, "distortion_params")
    shared = [key for key in (*INTRINSICS, *distortion) if key in meta]
    distorted = [key for key in shared if key in distortion]
    frames = meta["frames"]

    def differs(frame: Mapping[str, Any]) -> bool:
        return any(key in frame for key in (*shared, *(distortion if distorted else ())))

    lenses = [lens_of(meta, frame, "transforms.json") for frame in frames]
    sizes = {len(frame.get("distortion_params", meta.get("distortion_params", [0] * 6))) for frame in frames}
    if not any(map(differs, frames)) and distorted != ["k4"] and 4 not in sizes:
        return dict(meta)
    for frame, lens in zip(frames, lenses, strict=True):
        own = {key: meta[key] for key in INTRINSICS if key in meta}
        frame.update({**own, **frame, "distortion_params": list(lens.distortion)})
    return {key: value for key, value in meta.items() if key not in shared}


def colmap_lens(model: str, params: Sequence[float], where: str) -> tuple[tuple[float, float, float, float], Lens]:
    """Intrinsics ``fx, fy, cx, cy`` in pixels and the lens of a COLMAP camera.

    Raises:
        DataError: nerfstudio cannot undistort it; says what does.
    """
    names = COLMAP_LENSES[model][1].split()
    stated = dict(zip(names, map(float, params), strict=True))
    kind = _KINDS.get(model)
    if kind is None:
        kind, zeros = _SPECIAL_CASES.get(model, (None, ()))
        if kind is None or any(stated[name] for name in (*zeros, *(n for n in names if n.startswith("s")))):
            raise DataError(f"{where}: {_colmap_help(model)}")
    fx, fy = stated.get("fx", stated.get("f", 0.0)), stated.get("fy", stated.get("f", 0.0))
    return (fx, fy, stated["cx"], stated["cy"]), Lens(kind, tuple(stated.get(key, 0.0) for key in DISTORTION))


def _colmap_help(model: str) -> str:
    if model in _REFUSED:
        return f"camera model {model} is no lens that perspective images can be made of; {_REFUSED[model]}"
    return (
        f"nerfstudio does not support camera model {model}; make undistorted images with `colmap image_undistorter` "
        "and train on its output, or calibrate the capture with OPENCV"
    )


def check_colmap_model(model: int | str, where: str) -> str:
    """Name of a COLMAP camera model by its number or name; ``DataError`` with the way out if it cannot be read."""
    for name, (number, _) in COLMAP_LENSES.items():
        if model in (name, number):
            if name not in _KINDS and name not in _SPECIAL_CASES:
                raise DataError(f"{where}: {_colmap_help(name)}")
            return name
    raise DataError(f"{where}: camera model {model} is not known here; calibrate the capture with OPENCV")


def size_of_first_image(meta: Mapping[str, Any], folder: Path) -> tuple[int, int] | None:
    """Width and height in pixels of the image of the first frame, by its header; None if there is none."""
    from PIL import Image

    try:
        with Image.open(folder / meta["frames"][0]["file_path"]) as image:
            return image.size
    except (OSError, KeyError, IndexError, TypeError, ValueError):
        return None
