"""COLMAP models: a reader that needs neither COLMAP nor nerfstudio, and trusts no file.

The formats are those of COLMAP's documentation ("Output Format"). A binary file starts with a count of its entries; a
text has one line per entry, and a second one with the observations of an image. Text is read before binary, but
binary points before text, as nerfstudio does.

    cameras.bin   i32 number, i32 model, u64 width, u64 height, f64 per parameter
    images.bin    i32 number, 7 f64 quaternion wxyz and translation, i32 camera, name and a zero byte, u64 count,
                  24 bytes per observation
    points3D.bin  u64 number, 3 f64 position, 3 u8 colour, f64 error, u64 count, 8 bytes per observation

Nothing is allocated by a count: reading past the end of a file raises.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.data.capture import beside, finite, side
from sundae_ns.data.lenses import COLMAP_LENSES, Lens, colmap_lens, colmap_model

_CAMERA, _IMAGE, _COUNT = (struct.Struct(layout) for layout in ("<iiQQ", "<i7di", "<Q"))
_POINT = np.dtype([("number", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


class ColmapCamera(NamedTuple):
    """A camera of a model."""

    width: int
    height: int
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy, pixels."""
    lens: Lens


class ColmapImage(NamedTuple):
    """An image of a model."""

    name: str
    pose: tuple[float, ...]
    """World-to-camera with OpenCV axes: a quaternion wxyz of length 1, and a translation."""
    camera_id: int
    camera: ColmapCamera


def read_images(model: Path) -> dict[int, ColmapImage]:
    """The images of a model by their numbers, with their cameras; ``DataError`` names the first unusable entry."""
    if not model.is_dir():
        raise DataError(
            f"{model} is not a folder; give the folder of the model with colmap --colmap-path (usually sparse/0)"
        )
    kind = next((kind for kind in ("txt", "bin") if (model / f"cameras.{kind}").exists()), None)
    if kind is None:
        raise DataError(
            f"{model} holds neither cameras.bin nor cameras.txt{beside(model / 'cameras.bin')}; give the folder of the "
            "model with --colmap-path"
        )
    cameras: dict[int, ColmapCamera] = {}
    with _content(model / f"cameras.{kind}") as content:
        stated = _text_cameras(content) if kind == "txt" else _binary_cameras(content)
        for number, name, width, height, params in stated:
            where = f"cameras.{kind}, camera {number}"
            if number in cameras:
                raise DataError(f"{where}: it is listed twice; export it again")
            cameras[number] = _camera(colmap_model(name, where), width, height, params, where)
    images: dict[int, ColmapImage] = {}
    with _content(model / f"images.{kind}") as content:
        for number, pose, camera, file in _text_images(content) if kind == "txt" else _binary_images(content):
            where = f"images.{kind}, image {number}"
            for value in pose:
                finite(value, "the pose", where)
            if not abs(math.hypot(*pose[:4]) - 1) < 0.01:
                raise DataError(f"{where}: its quaternion is not of length 1, so it is no rotation; remove the image")
            if camera not in cameras:
                raise DataError(f"{where}: its camera {camera} is not in the model; export it again")
            images[number] = ColmapImage(file, pose, camera, cameras[camera])
    if not images:
        raise DataError(f"{model} has no images; the reconstruction failed, run it again")
    return images


def read_points(model: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions and colours ``[N, 3]`` of the points of a model; ``DataError`` if their file is missing or damaged."""
    if (model / "points3D.bin").exists():
        with _content(model / "points3D.bin") as content:
            starts, end = [], _COUNT.size
            for _ in range(*_COUNT.unpack_from(content)):
                starts.append(end)
                end += _POINT.itemsize
                end += 8 * _COUNT.unpack_from(content, end - _COUNT.size)[0]
            if end > len(content):
                raise ValueError(f"it ends {end - len(content):,} bytes early")
            crops = sliding_window_view(np.frombuffer(content + bytes(_POINT.itemsize), np.uint8), _POINT.itemsize)
            points = crops[starts].view(_POINT)[:, 0]
            return points["xyz"].copy(), points["rgb"].copy()
    if (model / "points3D.txt").exists():
        with _content(model / "points3D.txt") as content:
            rows = _rows(content)
            positions = np.array([[float(word) for word in row[1:4]] for row in rows], dtype=np.float64)
            colours = b"".join(bytes(int(word) for word in row[4:7]) for row in rows)
            return positions.reshape(len(rows), 3), np.frombuffer(colours, np.uint8).reshape(len(rows), 3).copy()
    raise DataError(f"{model} has no points3D.bin or .txt; add it, or start with colmap --load-3D-points False")


def check_colmap(model: Path, images: Path | None, *, points: bool = True) -> None:
    """Check the files of a COLMAP model, and the paths of its images, which nerfstudio passes to a shell.

    ``DataError`` names the first unusable entry. Without a folder of ``images`` they need not exist.
    """
    names = [image.name for image in read_images(model).values()]
    hostile = next((name for name in [str(images or ""), *names] if set(name) & set('"$`\\\n')), None)
    if hostile is not None:
        raise DataError(f"{hostile!r} has quotes, $, ` or backslashes in its name; rename it without them")
    missing = [images / name for name in names if not (images / name).is_file()] if images is not None else []
    if missing:
        raise DataError(
            f"{missing[0]} does not exist{beside(missing[0])}; check --images-path, or remove the view from the model"
        )
    if points and not len(read_points(model)[0]):
        raise DataError(f"{model} has no points; start without them with colmap --load-3D-points False")


@contextmanager
def _content(path: Path) -> Iterator[bytes]:
    with reading(path, f"a complete {path.name} of COLMAP", remedy="copy or export it again"):
        yield regular(path).read_bytes()


def _camera(model: str, width: int, height: int, params: Sequence[float], where: str) -> ColmapCamera:
    names = COLMAP_LENSES[model][2].split()
    if len(params) != len(names):
        raise DataError(f"{where}: {model} has {len(names)} parameters, not {len(params)}; export it again")
    for name, value in zip(names, params, strict=True):
        finite(value, f"parameter {name}", where, positive=name.startswith("f"))
    return ColmapCamera(side(width, "width", where), side(height, "height", where), *colmap_lens(model, params, where))


def _binary_cameras(content: bytes) -> Iterator[tuple[int, int, int, int, tuple[float, ...]]]:
    at = _COUNT.size
    for _ in range(*_COUNT.unpack_from(content)):
        number, kind, width, height = _CAMERA.unpack_from(content, at)
        params = struct.Struct(f"<{len(COLMAP_LENSES[colmap_model(kind, f'camera {number}')][2].split())}d")
        yield number, kind, width, height, params.unpack_from(content, at + _CAMERA.size)
        at += _CAMERA.size + params.size


def _binary_images(content: bytes) -> Iterator[tuple[int, tuple[float, ...], int, str]]:
    at = _COUNT.size
    for _ in range(*_COUNT.unpack_from(content)):
        number, *pose, camera = _IMAGE.unpack_from(content, at)
        start = at + _IMAGE.size
        end = content.index(b"\0", start, start + 4096)
        at = end + 1 + _COUNT.size
        at += 24 * _COUNT.unpack_from(content, end + 1)[0]
        if at > len(content):
            raise ValueError(f"it ends {at - len(content):,} bytes early")
        yield number, tuple(pose), camera, content[start:end].decode("utf-8")


def _rows(content: bytes, *, images: bool = False) -> list[list[str]]:
    """Words of the entries of a text. An image has a second line, and a name that may have spaces."""
    lines = map(str.strip, re.split(r"\r\n|\r|\n", content.decode("utf-8")))
    rows = []
    for line in lines:
        if line and not line.startswith("#"):
            rows.append(line.split(maxsplit=9 if images else -1))
            if images:
                next(lines, None)  # observations, which may be an empty line
    # A text cut between two lines has no other sign.
    stated = re.search(rb"^# Number of \w+: (\d+)", content, re.MULTILINE)
    if stated and int(stated[1]) != len(rows):
        raise ValueError(f"it states {int(stated[1]):,} entries and has {len(rows):,}")
    return rows


def _text_cameras(content: bytes) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    for number, name, width, height, *params in _rows(content):
        yield int(number), name, int(width), int(height), tuple(map(float, params))


def _text_images(content: bytes) -> Iterator[tuple[int, tuple[float, ...], int, str]]:
    for number, *pose, camera, name in _rows(content, images=True):
        if len(pose) != 7:
            raise ValueError(f"image {number} has {len(pose)} numbers as its pose")
        yield int(number), tuple(map(float, pose)), int(camera), name
