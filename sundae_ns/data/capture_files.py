"""The files of a capture, of photos and a model or of ``sundae demo``: images, masks, poses, points."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL.Image import Resampling

from sundae_ns.core.camera import OPENGL_TO_OPENCV
from sundae_ns.core.errors import DataError, writing
from sundae_ns.core.files import write_text
from sundae_ns.data.capture import read_json
from sundae_ns.data.images import JPEG, check_image, decoded, decoded_mask
from sundae_ns.data.layouts import LONGEST_SIDE
from sundae_ns.data.photos import LEAST_PHOTOS, Photo, Warn, upright, usable

TRANSFORMS = "transforms.json"
MARKER = ".sundae_scene"  # in a copy of the demo's capture; it permits to replace it
ARCHIVE = Path(__file__).with_name("demo_capture.zip")  # ray-traced: 48 training, 8 test images, 5,000 points
CLOUD = "sparse_pc.ply"
# From COLMAP's coordinates, whose y points down in most captures, to those of the capture, whose z points up.
APPLIED = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
Advance = Callable[[int], None]  # called with the number of further parts of a stage that are done


class Placed(NamedTuple):
    """Names of the photos of a capture in their order, and what :func:`.find_poses` reports of them."""

    placed: Mapping[str, str]  # by the paths of their images in the capture
    left_out: tuple[str, ...]  # those without a pose
    cameras: int = 1
    error: float = 0.0  # mean reprojection error, pixels
    models: tuple[int, ...] = ()  # numbers of images of COLMAP's models; the first and largest is the capture

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
        """Advice on photos to take again, as the end of a sentence."""
        if not self.placed or not self.left_out:
            return "add sharp photos that overlap by two thirds"
        at = {name: index for index, name in enumerate(sorted([*self.placed.values(), *self.left_out]))}
        gaps = [(abs(at[a] - at[b]), at[b], at[a], a, b) for a in self.placed.values() for b in self.left_out]
        *_, near, lost = min(gaps)
        return f"photograph the way from {near} to {lost} again, sharp and in steps that overlap by two thirds"


def placed_in(capture: Path) -> Placed:
    """The photos of a capture; ``DataError`` if its ``transforms.json`` is missing or damaged."""
    meta = read_json(capture / TRANSFORMS)
    frames, left_out = meta.get("frames"), meta.get("left_out", [])
    if not isinstance(frames, list) or not isinstance(left_out, list):
        raise DataError(f"{capture / TRANSFORMS} lists no frames; remove it to make it again")
    paths = {str(frame.get("file_path")): frame for frame in frames if isinstance(frame, dict)}
    return Placed({path: str(frame.get("original", path)) for path, frame in paths.items()}, tuple(map(str, left_out)))


def names_of(photos: Sequence[Photo]) -> list[str]:
    """Paths of images in the working folder, ``c1/frame_00001.jpg``; photos of a camera and a size share a folder."""
    cameras: dict[object, int] = {}
    numbers = [cameras.setdefault((photo.size, photo.lens), len(cameras) + 1) for photo in photos]
    names = (f"c{camera}/frame_{number:05d}" for number, camera in enumerate(numbers, start=1))
    return [name + photo.suffix for name, photo in zip(names, photos, strict=True)]


def write_images(photos: Sequence[Photo], folder: Path, warn: Warn, advance: Advance) -> dict[str, Photo]:
    """Write the photos, upright and in sRGB, unless their images exist; those :func:`.usable`, by their images."""

    def write(item: tuple[str, Photo]) -> tuple[str, Photo]:
        path, photo = folder / item[0], item[1]
        advance(1)
        if not path.exists():
            with writing(f"cannot write {path}"):
                path.parent.mkdir(parents=True, exist_ok=True)
                partial = path.with_name(f"{path.name}.partial")
                image, exif = upright(photo)  # decodes, so that a broken photo is named before hours of work
                if photo.as_it_is:
                    shutil.copyfile(photo.path, partial)
                elif photo.suffix == ".png":
                    image.save(partial, format="PNG", exif=exif)
                else:
                    image.convert("L" if image.mode == "L" else "RGB").save(partial, "JPEG", exif=exif, **JPEG)
                partial.replace(path)
        return item

    return dict(usable(list(zip(names_of(photos), photos, strict=True)), write, warn))


def write_smaller(images: Path, advance: Advance = lambda _: None, *, masks: bool = False) -> None:
    """Write ``images_2``, ``images_4``, ``images_8`` beside a folder, and more until one has 1,600 pixels at most."""
    # Odd sizes are rounded down, as nerfstudio rounds those of cameras. Masks get no new values.
    paths = sorted(images.iterdir())
    longest = max(max(check_image(path, mask=masks)) for path in paths)
    factors = [2, 4, 8]
    while longest / factors[-1] > LONGEST_SIDE:
        factors.append(2 * factors[-1])
    for path in paths:
        image = decoded(path)
        for factor in factors:
            folder = images.with_name(f"{images.name}_{factor}")
            folder.mkdir(exist_ok=True)
            size = max(1, image.width // factor), max(1, image.height // factor)
            image.resize(size, Resampling.NEAREST if masks else Resampling.BOX).save(folder / path.name, **JPEG)
        advance(1)


def write_capture(
    out: Path, model: Any, images: Path, sources: Mapping[str, str], masks: Mapping[str, Path], advance: Advance
) -> None:
    """Write a capture into a folder, which is replaced, of a ``pycolmap.Reconstruction`` of the ``images`` of a folder.

    ``sources`` are names of photos, also of those without a pose, and ``masks`` paths, both by the names of the images.
    """
    shutil.rmtree(out, ignore_errors=True)
    stored = out / "colmap" / "sparse" / "0"
    for folder in (out / "images", stored, *([out / "masks"] if masks else [])):
        folder.mkdir(parents=True)
    for name in (image.name for image in model.images.values() if image.has_pose):
        source, target = images / name, out / "images" / Path(name).name
        try:
            os.link(source, target)
        except OSError:  # a disk without hard links
            shutil.copyfile(source, target)
        if masks:
            mask = decoded_mask(masks[name]).resize(check_image(source), Resampling.NEAREST)
            mask.save(out / "masks" / f"{target.stem}.png")
    write_smaller(out / "images", advance)
    if masks:
        write_smaller(out / "masks", masks=True)
    model.write(stored)
    points = np.array([(APPLIED[:, :3] @ point.xyz, point.color) for point in model.points3D.values()], "3<f4, 3u1")
    columns = [f"property {x}" for x in ("float x", "float y", "float z", "uchar red", "uchar green", "uchar blue")]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *columns, "end_header", ""]
    (out / CLOUD).write_bytes("\n".join(head).encode() + points.tobytes())
    write_text(out / TRANSFORMS, json.dumps(transforms_of(model, sources, masked=bool(masks)), indent=4) + "\n")


def transforms_of(model: Any, sources: Mapping[str, str], *, masked: bool = False) -> dict[str, Any]:
    """Contents of the ``transforms.json`` of a model; ``sources`` without a pose are ``left_out``."""
    cameras = {number: _intrinsics(camera) for number, camera in model.cameras.items()}
    posed = {image.name: image for image in model.images.values() if image.has_pose}
    shared = {image.camera_id for image in posed.values()}
    names = sorted({*posed, *sources}, key=lambda name: Path(name).name)
    frames = [
        {
            "file_path": f"images/{Path(name).name}",
            "original": sources[name],
            **({"mask_path": f"masks/{Path(name).stem}.png"} if masked else {}),
            **({} if len(shared) == 1 else cameras[posed[name].camera_id]),
            "transform_matrix": _pose(np.asarray(posed[name].cam_from_world().matrix())).tolist(),
        }
        for name in filter(posed.__contains__, names)
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
    f, *values = (float(value) for value in camera.params)
    values = [f, f, *values, 0.0, 0.0, 0.0] if len(values) == 3 else [f, *values]  # SIMPLE_RADIAL is a case of OPENCV
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    return {"w": int(camera.width), "h": int(camera.height), **dict(zip(names, values, strict=True))}


def _pose(camera_from_world: np.ndarray) -> np.ndarray:
    """Camera-to-world ``[4, 4]`` with OpenGL axes, in the capture's coordinates, of COLMAP's pose ``[3, 4]``."""
    pose = np.linalg.inv([*camera_from_world, (0, 0, 0, 1)]) * (*OPENGL_TO_OPENCV, 1.0)
    return np.array([*(APPLIED[:, :3] @ pose[:3]), (0, 0, 0, 1)])


def write_demo_capture(out: Path) -> Path:
    """Write the demo's capture as a nerfstudio data set to a folder; returns that folder, the value for ``--data``.

    An earlier copy is replaced, other files are a ``DataError``. An interrupted copy has no ``transforms.json``.
    """
    if out.is_dir() and any(out.iterdir()) and not (out / MARKER).exists():
        raise DataError(f"{out} holds other files than the demo's capture; name a new or an empty folder")
    (out / "images").mkdir(parents=True, exist_ok=True)
    (out / MARKER).touch()
    (out / TRANSFORMS).unlink(missing_ok=True)
    with zipfile.ZipFile(ARCHIVE) as archive:
        for name in sorted(archive.namelist(), key=lambda name: (name == TRANSFORMS, name)):
            (out / name).write_bytes(archive.read(name))
    return out
