"""COLMAP models: a reader that needs neither COLMAP nor nerfstudio, and trusts no file.

The formats are those of COLMAP's documentation ("Output Format"). A binary file starts with a count of its entries; a
text has one line per entry, and a second one with the observations of an image. Text is read before binary, but
binary points before text, as nerfstudio does. Names of images may have the backslashes of Windows.

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
    """A camera of a model; ``intrinsics`` are fx, fy, cx, cy in pixels."""

    width: int
    height: int
    intrinsics: tuple[float, float, float, float]
    lens: Lens


class ColmapImage(NamedTuple):
    """An image of a model; its pose is world-to-camera with OpenCV axes: a unit quaternion wxyz and a translation."""

    name: str
    pose: tuple[float, ...]
    camera_id: int
    camera: ColmapCamera


def read_images(model: Path, kinds: Sequence[str] = ("txt", "bin")) -> dict[int, ColmapImage]:
    """The images of a model by their numbers, with their cameras; ``DataError`` names the first unusable entry."""
    if not (present := [kind for kind in kinds if (model / f"cameras.{kind}").exists()]):
        none = f"{model} holds neither cameras.bin nor cameras.txt{beside(model / 'cameras.bin')}"
        raise DataError(f"{none}; give colmap --colmap-path the folder of the model, usually sparse/0")
    kind = present[0]
    cameras, images = dict[int, ColmapCamera](), dict[int, ColmapImage]()
    numbers = dict[str, int]()
    with _content(model / f"cameras.{kind}") as content:
        for number, name, width, height, params in _cameras(content, kind == "txt"):
            where = f"{model / f'cameras.{kind}'}, camera {number}"
            if number in cameras:
                raise DataError(f"{where}: it is listed twice; export it again")
            names = COLMAP_LENSES[lens := colmap_model(name, where)][2].split()
            if len(params) != len(names):
                raise DataError(f"{where}: {lens} has {len(names)} parameters, not {len(params)}; export it again")
            if any(map(math.isnan, params)):  # so RealityScan writes a lens that it has not found
                raise DataError(f"{where}: its lens is NaN; leave its images out of the export, or remove them here")
            for name, value in zip(names, params, strict=True):
                finite(value, f"parameter {name}", where, positive=name.startswith("f"))
            size = side(width, "width", where), side(height, "height", where)
            cameras[number] = ColmapCamera(*size, *colmap_lens(lens, params, where))
    with _content(model / f"images.{kind}") as content:
        for number, pose, camera, file in _images(content, kind == "txt"):
            where = f"{model / f'images.{kind}'}, image {number}"
            for value in pose:
                finite(value, "the pose", where)
            if not abs(math.hypot(*pose[:4]) - 1) < 0.01:
                raise DataError(f"{where}: its quaternion is not of length 1, so it is no rotation; remove the image")
            if camera not in cameras:
                raise DataError(f"{where}: its camera {camera} is not in the model; export it again")
            if Path(file).is_absolute() or ".." in Path(file).parts:
                raise DataError(f"{where}: its name {file!r:.80} leads out of the folder of images; rename it")
            if number in images or numbers.setdefault(file, number) != number:
                raise DataError(f"{where}: its number or its name {file!r:.80} is listed twice; remove one of the two")
            images[number] = ColmapImage(file, pose, camera, cameras[camera])
    other = read_images(model, ["bin"]) if len(present) > 1 else images
    if other.keys() != images.keys() or any(math.dist(_numbers(other[n]), _numbers(images[n])) > 0.01 for n in images):
        raise DataError(f"{model} holds a text and a binary model that differ; remove the outdated one")
    if not images:
        raise DataError(f"{model} has no images; the reconstruction failed, run it again")
    return images


def _numbers(image: ColmapImage) -> tuple[float, ...]:
    return (*image.pose, *image.camera[:2], *image.camera.intrinsics, *image.camera.lens.distortion)


def read_points(model: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions and colours ``[N, 3]`` of the points of a model; ``DataError`` if their file is missing or damaged."""
    if (model / "points3D.bin").exists():
        with _content(model / "points3D.bin") as content:
            starts, end = [], _COUNT.size
            for _ in range(*_COUNT.unpack_from(content)):
                starts.append(end)
                end += _POINT.itemsize
                end += 8 * _COUNT.unpack_from(content, end - _COUNT.size)[0]
            if end != len(content):
                raise ValueError(f"its entries take {end:,} bytes, it has {len(content):,}")
            windows = sliding_window_view(np.frombuffer(content + bytes(_POINT.itemsize), np.uint8), _POINT.itemsize)
            points = windows[starts].view(_POINT)[:, 0]
            return points["xyz"].copy(), points["rgb"].copy()
    if (model / "points3D.txt").exists():
        with _content(model / "points3D.txt") as content:
            rows = _rows(content, splits=7)  # the rest of a line is its track
            positions = np.array([[float(word) for word in row[1:4]] for row in rows], dtype=np.float64)
            colours = b"".join(bytes(int(word) for word in row[4:7]) for row in rows)
            return positions.reshape(len(rows), 3), np.frombuffer(colours, np.uint8).reshape(len(rows), 3).copy()
    raise DataError(f"{model} has no points3D.bin or .txt; add it, or start with colmap --load-3D-points False")


def check_colmap(model: Path, images: Path | None, *, points: bool = True) -> None:
    """Check the files of a COLMAP model, and its images, if their folder is given, whose paths reach a shell."""
    if len(names := [image.name for image in read_images(model).values()]) < 2:
        raise DataError(f"{model} has {len(names)} image; training needs 2 or more")
    if hostile := next((name for name in [str(images or ""), *names] if set(name) & set('"$`\\\n')), None):
        raise DataError(f"{hostile!r} has quotes, $, ` or backslashes in its name; rename it without them")
    if images is not None and (missing := [images / name for name in names if not (images / name).is_file()]):
        raise DataError(f"{missing[0]} does not exist{beside(missing[0])}; put it there, or run colmap image_deleter")
    if points and not len(read_points(model)[0]):
        raise DataError(f"{model} has no points; start without them with colmap --load-3D-points False")


@contextmanager
def _content(path: Path) -> Iterator[bytes]:
    with reading(path, f"a complete {path.name} of COLMAP", remedy="copy or export it again"):
        yield regular(path).read_bytes()


def _cameras(content: bytes, text: bool) -> Iterator[tuple[int, str | int, int, int, tuple[float, ...]]]:
    if text:
        for number, name, width, height, *params in _rows(content):
            yield int(number), name, int(width), int(height), tuple(float(word.split("(")[0]) for word in params)
        return
    at = _COUNT.size
    for _ in range(*_COUNT.unpack_from(content)):
        number, kind, width, height = _CAMERA.unpack_from(content, at)
        layout = struct.Struct(f"<{len(COLMAP_LENSES[colmap_model(kind, f'camera {number}')][2].split())}d")
        yield number, kind, width, height, layout.unpack_from(content, at + _CAMERA.size)
        at += _CAMERA.size + layout.size


def _images(content: bytes, text: bool) -> Iterator[tuple[int, tuple[float, ...], int, str]]:
    if text:
        for number, *words, camera, name in _rows(content, images=True, splits=9):
            if len(words) != 7:
                raise ValueError(f"image {number} has {len(words)} numbers as its pose")
            yield int(number), tuple(map(float, words)), int(camera), name.replace("\\", "/")
        return
    at = _COUNT.size
    for _ in range(*_COUNT.unpack_from(content)):
        number, *pose, camera = _IMAGE.unpack_from(content, at)
        start = at + _IMAGE.size
        end = content.index(b"\0", start, start + 4096)
        at = end + 1 + _COUNT.size + 24 * _COUNT.unpack_from(content, end + 1)[0]
        yield number, tuple(pose), camera, content[start:end].decode("utf-8").replace("\\", "/")
    if at != len(content):
        raise ValueError(f"its entries take {at:,} bytes, it has {len(content):,}")


def _rows(content: bytes, *, images: bool = False, splits: int = -1) -> list[list[str]]:
    """Words of the entries of a text, after some splits the rest of the line. An image has a second line."""
    lines = map(str.strip, re.split(r"\r\n|\r|\n", content.decode("utf-8-sig")))
    rows = []
    for line in lines:
        if line and not line.startswith("#"):
            rows.append(line.split(maxsplit=splits))
            if images and not re.fullmatch(r"(?:.*\s)?-?[\d.]+|#.*|", next(lines, "")):
                raise ValueError(f"after image {line.split()[0]} stands no line of observations, which may be empty")
    # A text cut between two lines has no other sign.
    if (stated := re.search(rb"^# Number of \w+: (\d+)", content, re.MULTILINE)) and int(stated[1]) != len(rows):
        raise ValueError(f"it states {int(stated[1]):,} entries and has {len(rows):,}")
    return rows
