"""The files of a capture: images at several sizes, masks, ``transforms.json`` and points, from photos and a model."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from sundae_ns.core.camera import OPENGL_TO_OPENCV
from sundae_ns.core.errors import DataError, writing
from sundae_ns.core.files import write_text
from sundae_ns.data.capture import check_image, read_json, undecodable
from sundae_ns.data.layouts import LONGEST_SIDE
from sundae_ns.data.photos import LEAST_PHOTOS, Photo, upright

TRANSFORMS = "transforms.json"
CLOUD = "sparse_pc.ply"
APPLIED = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
"""From COLMAP's coordinates, whose y points down in most captures, to those of the capture, whose z points up."""
_JPEG: dict[str, Any] = {"quality": 95, "subsampling": 0}


class Placed(NamedTuple):
    """Photos of a capture in the order of their names, and what :func:`.find_poses` reports of them."""

    placed: tuple[str, ...]
    left_out: tuple[str, ...]
    """Those without a pose."""
    cameras: int = 1
    error: float = 0.0
    """Mean reprojection error, pixels."""
    models: tuple[int, ...] = ()
    """Numbers of photos of COLMAP's models, the largest first; it is the capture."""
    masks: str | None = None
    """How many frames have a mask, ``24 of 24``; None without masks."""

    @property
    def total(self) -> int:
        """Number of photos."""
        return len(self.placed) + len(self.left_out)

    @property
    def enough(self) -> bool:
        """Whether a good scene can be trained: half of the photos overlap enough to have a pose."""
        return len(self.placed) >= max(LEAST_PHOTOS, 0.5 * self.total)

    @property
    def again(self) -> str:
        """What to photograph again, as the end of a sentence."""
        if not self.placed or not self.left_out:
            return "add sharp photos that overlap by two thirds"
        order = {name: index for index, name in enumerate(sorted([*self.placed, *self.left_out]))}
        gaps = [(abs(order[a] - order[b]), order[b], order[a], a, b) for a in self.placed for b in self.left_out]
        *_, near, lost = min(gaps)
        return f"photograph the way from {near} to {lost} again, sharp and in steps that overlap by two thirds"


def placed_in(capture: Path) -> Placed:
    """The photos of a capture; ``DataError`` if its ``transforms.json`` is missing or damaged."""
    path = capture / TRANSFORMS
    meta = read_json(path)
    frames, left_out = meta.get("frames"), meta.get("left_out", [])
    if not isinstance(frames, list) or not isinstance(left_out, list):
        raise DataError(f"{path} lists no frames; remove it to make it again")
    stated = [frame.get("original", frame.get("file_path", "")) if isinstance(frame, dict) else "" for frame in frames]
    return Placed(tuple(map(str, stated)), tuple(map(str, left_out)))


def names_of(photos: Sequence[Photo]) -> list[str]:
    """Paths of images in the working folder, ``c1/frame_00001.jpg``, in the order of the photos.

    Photos of a folder ``c1``, ``c2``, ... share size, camera, lens and focal length.
    """
    cameras: dict[object, int] = {}
    names = []
    for number, photo in enumerate(photos, start=1):
        camera = cameras.setdefault((photo.size, photo.lens), len(cameras) + 1)
        names.append(f"c{camera}/frame_{number:05d}{photo.suffix}")
    return names


def write_images(photos: Sequence[Photo], folder: Path, advance: Callable[[int], None]) -> None:
    """Write the photos, upright, under their :func:`names_of`; images that exist stay.

    Raises:
        DataError: the pixels of a photo cannot be decoded, or a raw photo has another size than the others.
        StorageError: the disk is full or not writable.
    """
    raw: set[tuple[int, int]] = set()
    for photo, name in zip(photos, names_of(photos), strict=True):
        path = folder / name
        if not path.exists():
            with writing(f"cannot write {path}"):
                path.parent.mkdir(parents=True, exist_ok=True)
                _write_image(photo, path)
        if photo.size == (0, 0):
            raw.add(check_image(path))
        if len(raw) > 1:
            raise DataError(f"raw photos of several sizes ({photo.path} differs); save them as JPEG")
        advance(1)


def _write_image(photo: Photo, path: Path) -> None:
    partial = path.with_name(f"{path.name}.partial")
    image = upright(photo)  # decodes: what is broken is named before the work of hours
    if photo.as_it_is:
        shutil.copyfile(photo.path, partial)
    else:
        kind = "PNG" if photo.suffix == ".png" else "JPEG"
        image = image if kind == "PNG" or image.mode == "L" else image.convert("RGB")
        image.save(partial, format=kind, exif=image.getexif(), **_JPEG)
    partial.replace(path)


def write_smaller(images: Path, advance: Callable[[int], None]) -> None:
    """Write ``images_2``, ``images_4``, ... beside a folder: three sizes, or more until one has 1,600 pixels at most.

    Odd sizes are rounded down, as nerfstudio rounds those of cameras.
    """
    paths = sorted(images.iterdir())
    longest, factors = max(max(check_image(path)) for path in paths), [2, 4, 8]
    while longest / factors[-1] > LONGEST_SIDE:
        factors.append(2 * factors[-1])
    folders = {factor: images.with_name(f"{images.name}_{factor}") for factor in factors}
    for folder in folders.values():
        folder.mkdir(exist_ok=True)
    for path in paths:
        try:
            with Image.open(path) as opened:
                image = opened.copy()
        except Exception as error:  # decoders raise many kinds
            raise undecodable(path, error) from error
        for factor, folder in folders.items():
            size = max(1, image.width // factor), max(1, image.height // factor)
            image.resize(size, Image.Resampling.BOX).save(folder / path.name, **_JPEG)
        advance(1)


def write_capture(
    out: Path, model: Any, images: Path, sources: Mapping[str, str], advance: Callable[[int], None]
) -> None:
    """Write a capture into a folder, ``transforms.json`` last.

    Args:
        out: the folder; it is replaced.
        model: ``pycolmap.Reconstruction``.
        images: folder of the images of the model, each in a folder of its camera.
        sources: names of the photos, by the names of their images; also of those without a pose.
        advance: called with the number of further images.
    """
    shutil.rmtree(out, ignore_errors=True)
    (out / "images").mkdir(parents=True)
    for image in model.images.values():
        if image.has_pose:
            source, target = images / image.name, out / "images" / Path(image.name).name
            try:
                os.link(source, target)
            except OSError:  # a disk without hard links
                shutil.copyfile(source, target)
    write_smaller(out / "images", advance)
    stored = out / "colmap" / "sparse" / "0"
    stored.mkdir(parents=True)
    model.write(stored)
    kinds = [(axis, "f4") for axis in "xyz"] + [(channel, "u1") for channel in ("red", "green", "blue")]
    points = [(*(APPLIED[:, :3] @ point.xyz), *point.color) for point in model.points3D.values()]
    table = PlyElement.describe(np.array(points, dtype=kinds), "vertex")
    with (out / CLOUD).open("wb") as file:
        PlyData([table], byte_order="<").write(file)
    write_text(out / TRANSFORMS, json.dumps(transforms_of(model, sources), indent=4) + "\n")


def transforms_of(model: Any, sources: Mapping[str, str]) -> dict[str, Any]:
    """Contents of the ``transforms.json`` of a model: intrinsics at the top if all images share a camera.

    Args:
        model: ``pycolmap.Reconstruction`` with cameras of the kind OPENCV or SIMPLE_RADIAL.
        sources: names of the photos, by the names of their images. A frame states its photo as ``original``; photos
            without a pose are ``left_out``.
    """
    cameras = {number: _intrinsics(camera) for number, camera in model.cameras.items()}
    posed = {image.name: image for image in model.images.values() if image.has_pose}
    shared = {image.camera_id for image in posed.values()}
    names = sorted({*posed, *sources}, key=lambda name: Path(name).name)
    frames = [
        {
            "file_path": f"images/{Path(name).name}",
            "original": sources[name],
            **({} if len(shared) == 1 else cameras[posed[name].camera_id]),
            "transform_matrix": _pose(np.asarray(posed[name].cam_from_world().matrix())).tolist(),
        }
        for name in names
        if name in posed
    ]
    return {
        "camera_model": "OPENCV",
        **(cameras[shared.pop()] if len(shared) == 1 else {}),
        "applied_transform": APPLIED.tolist(),
        "ply_file_path": CLOUD,
        "left_out": [sources[name] for name in names if name not in posed],
        "frames": frames,
    }


def _intrinsics(camera: Any) -> dict[str, float]:
    values = [float(value) for value in camera.params]
    if len(values) == 4:  # SIMPLE_RADIAL, a special case of OPENCV
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


def add_masks(capture: Path, masks: Sequence[Path]) -> str:
    """Copy the masks of all photos into a capture, at the sizes of its images; returns how many frames have one."""
    by_name = {f"frame_{number:05d}": mask for number, mask in enumerate(masks, start=1)}
    for images in sorted(capture.glob("images*")):
        folder = capture / images.name.replace("images", "masks", 1)
        folder.mkdir(exist_ok=True)
        for image in images.iterdir():
            if image.stem in by_name:
                try:
                    with Image.open(by_name[image.stem]) as mask:
                        scaled = mask.convert("L").resize(check_image(image), Image.Resampling.NEAREST)
                except (OSError, ValueError, SyntaxError) as error:
                    raise undecodable(by_name[image.stem], error) from error
                scaled.save(folder / f"{image.stem}.png")
    meta = read_json(capture / TRANSFORMS)
    for frame in meta["frames"]:
        name = Path(frame["file_path"]).stem
        if name in by_name:
            frame["mask_path"] = f"masks/{name}.png"
    write_text(capture / TRANSFORMS, json.dumps(meta, indent=4) + "\n")
    return f"{sum('mask_path' in frame for frame in meta['frames'])} of {len(meta['frames'])}"
