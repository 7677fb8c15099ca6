"""A reconstruction as a capture of nerfstudio: images at several sizes, ``transforms.json``, points, masks."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from plyfile import PlyData, PlyElement

from sundae_ns.data.camera_axes import OPENGL_TO_OPENCV
from sundae_ns.data.capture import read_json
from sundae_ns.data.photos import LEAST_PHOTOS
from sundae_ns.errors import DataError
from sundae_ns.poses.images import write_smaller
from sundae_ns.poses.reconstruction import Advance, load_model
from sundae_ns.storage.atomic import write_text

TRANSFORMS = "transforms.json"
_SIMPLE = ("f", "cx", "cy", "k")
"""Parameters of COLMAP's camera model SIMPLE_RADIAL; a special case of OPENCV."""
LEAST_SHARE = 0.5
"""Share of the photos that must have a pose; where fewer have, they overlap too little for a good scene."""
CLOUD = "sparse_pc.ply"
APPLIED = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
"""From COLMAP's coordinates, whose y points down in most captures, to those of the capture, whose z points up."""


class Placed(NamedTuple):
    """Photos of a capture, in the order of their names."""

    placed: tuple[str, ...]
    left_out: tuple[str, ...]
    """Those without a pose."""

    @property
    def total(self) -> int:
        """Number of photos."""
        return len(self.placed) + len(self.left_out)

    @property
    def enough(self) -> bool:
        """Whether a scene can be trained."""
        return len(self.placed) >= max(LEAST_PHOTOS, LEAST_SHARE * self.total)

    @property
    def again(self) -> str:
        """What to photograph again, as the end of a sentence."""
        if not self.placed or not self.left_out:
            return "add sharp photos that overlap by two thirds"
        names = sorted([*self.placed, *self.left_out])
        lost = {name: place for place, name in enumerate(names) if name in set(self.left_out)}
        found = [place for place, name in enumerate(names) if name not in lost]
        gaps = [(min(abs(place - other) for other in found), name, place) for name, place in lost.items()]
        _, name, place = min(gaps)
        near = names[min(found, key=lambda other: abs(place - other))]
        return f"photograph the way from {near} to {name} again, sharp and in steps that overlap by two thirds"


def placed_in(capture: Path) -> Placed:
    """The photos of a capture; ``DataError`` if its ``transforms.json`` is missing or damaged."""
    path = capture / TRANSFORMS
    meta = read_json(path)
    frames, left_out = meta.get("frames"), meta.get("left_out", [])
    if not isinstance(frames, list) or not isinstance(left_out, list):
        raise DataError(f"{path} lists no frames; remove it to make it again")
    stated = [frame.get("original", frame.get("file_path", "")) if isinstance(frame, dict) else "" for frame in frames]
    return Placed(tuple(map(str, stated)), tuple(map(str, left_out)))


def write_capture(out: Path, model: Path, images: Path, sources: Mapping[str, str], advance: Advance) -> None:
    """Write a capture into a folder, ``transforms.json`` last.

    Args:
        out: the folder; an earlier half of it is replaced.
        model: folder of COLMAP's model.
        images: folder of the images of the model, each in a folder of its camera.
        sources: names of the photos, by the names of their images; also of those without a pose.
        advance: called with the number of further images.
    """
    shutil.rmtree(out, ignore_errors=True)
    (out / "images").mkdir(parents=True)
    reconstruction = load_model(model)
    for image in reconstruction.images.values():
        if image.has_pose:
            _link(images / image.name, out / "images" / Path(image.name).name)
    write_smaller(out / "images", advance)
    stored = out / "colmap" / "sparse" / "0"
    stored.mkdir(parents=True)
    reconstruction.write(stored)
    points = list(reconstruction.points3D.values())
    with (out / CLOUD).open("wb") as file:
        _cloud([point.xyz for point in points], [point.color for point in points]).write(file)
    write_text(out / TRANSFORMS, json.dumps(transforms_of(reconstruction, sources), indent=4) + "\n")


def transforms_of(model: Any, sources: Mapping[str, str]) -> dict[str, Any]:
    """Contents of the ``transforms.json`` of a model: intrinsics at the top if all images share a camera.

    Args:
        model: ``pycolmap.Reconstruction`` with cameras of the kind OPENCV or SIMPLE_RADIAL.
        sources: names of the photos, by the names of their images. A frame states its photo as ``original``; those
            without a pose are ``left_out``.
    """
    cameras = {identifier: _intrinsics(camera) for identifier, camera in model.cameras.items()}
    placed = sorted((image for image in model.images.values() if image.has_pose), key=lambda one: Path(one.name).name)
    shared = {image.camera_id for image in placed}
    frames = [
        {
            "file_path": f"images/{Path(image.name).name}",
            "original": sources[image.name],
            **({} if len(shared) == 1 else cameras[image.camera_id]),
            "transform_matrix": _pose(np.asarray(image.cam_from_world().matrix())).tolist(),
        }
        for image in placed
    ]
    left_out = sorted(set(sources) - {image.name for image in placed}, key=lambda name: Path(name).name)
    top = cameras[shared.pop()] if len(shared) == 1 else {}
    stated: dict[str, Any] = {"applied_transform": APPLIED.tolist(), "ply_file_path": CLOUD}
    stated["left_out"] = [sources[name] for name in left_out]
    return {"camera_model": "OPENCV", **top, **stated, "frames": frames}


def _intrinsics(camera: Any) -> dict[str, float]:
    values = [float(value) for value in camera.params]
    if len(values) == len(_SIMPLE):
        focal, cx, cy, k1 = values
        values = [focal, focal, cx, cy, k1, 0.0, 0.0, 0.0]
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    return {"w": int(camera.width), "h": int(camera.height), **dict(zip(names, values, strict=True))}


def _pose(camera_from_world: np.ndarray) -> np.ndarray:
    """Camera-to-world ``[4, 4]`` with OpenGL axes, in the capture's coordinates, of COLMAP's pose ``[3, 4]``."""
    rotation, translation = camera_from_world[:, :3], camera_from_world[:, 3]
    pose = np.eye(4)
    pose[:3, :3] = APPLIED[:, :3] @ rotation.T * np.array(OPENGL_TO_OPENCV)
    pose[:3, 3] = APPLIED[:, :3] @ (-rotation.T @ translation)
    return pose


def _cloud(points: Sequence[np.ndarray], colors: Sequence[np.ndarray]) -> PlyData:
    """Points, in the capture's coordinates, with their colours."""
    kinds = [(axis, "f4") for axis in "xyz"] + [(channel, "u1") for channel in ("red", "green", "blue")]
    table = np.zeros(len(points), dtype=kinds)
    if points:
        for axis, values in zip("xyz", (np.array(points) @ APPLIED[:, :3].T).T, strict=True):
            table[axis] = values
        for channel, values in zip(("red", "green", "blue"), np.array(colors).T, strict=True):
            table[channel] = values
    return PlyData([PlyElement.describe(table, "vertex")], text=False, byte_order="<")


def _link(source: Path, target: Path) -> None:
    """A second name of a file, or a copy on a disk without such names."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
