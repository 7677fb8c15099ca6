"""Checks of a COLMAP model before it is parsed: cameras, images and points, binary or text.

nerfstudio's readers trust every count in a file and allocate by it. These checks read each file once and keep only
names and identifiers. The formats are those of COLMAP's documentation ("Output Format").
"""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from sundae_ns.data.beside import beside
from sundae_ns.data.capture import finite, read_bytes, side
from sundae_ns.data.lenses import COLMAP_LENSES, Lens, check_colmap_model, colmap_lens
from sundae_ns.errors import DataError, one_line, reading, regular

_SHELL = set('"$`\\\n')
"""Characters that end a quoted word: nerfstudio passes paths of images to a shell when it scales images down."""
_CAMERA, _IMAGE, _POINT, _COUNT = map(struct.Struct, ("<iiQQ", "<i7di", "<Q3d3Bd", "<Q"))
_IMAGE_BYTES = _IMAGE.size + 1 + _COUNT.size  # at least, with an empty name and no observations
_OBSERVATION, _TRACK = 24, 8
_MAX_NAME = 4096


class StatedCamera(NamedTuple):
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
    camera: StatedCamera


class _BinaryFile:
    """A binary file, read from front to back; reading past its end raises ``DataError``."""

    def __init__(self, path: Path) -> None:
        self.name, self.content, self.position = path.name, read_bytes(path), 0

    def take(self, layout: struct.Struct) -> tuple[float, ...]:
        """Read the values of ``layout``."""
        start = self.position
        self.skip(layout.size)
        return layout.unpack_from(self.content, start)

    def skip(self, length: int) -> None:
        self.position += length
        if self.position > len(self.content):
            raise DataError(f"{self.name} ends early, in a part of {length:,} bytes; copy or export it again")

    def count(self, item_bytes: int, items: str) -> int:
        """Read a count of items that take at least ``item_bytes`` each."""
        (count,) = self.take(_COUNT)
        if count * item_bytes > len(self.content) - self.position:
            raise DataError(f"{self.name} states {count:,} {items}, more than it can hold; copy or export it again")
        return int(count)

    def text(self) -> str:
        """Read UTF-8 text up to a zero byte."""
        end = self.content.find(b"\0", self.position, self.position + _MAX_NAME)
        if end < 0:
            raise DataError(f"{self.name} holds a name without an end; copy or export it again")
        start, self.position = self.position, end + 1
        try:
            return self.content[start:end].decode("utf-8")
        except UnicodeDecodeError as error:
            raise DataError(f"{self.name} holds a name that is not UTF-8; copy or export it again") from error


def check_colmap(model: Path, images: Path | None, *, points: bool = True) -> None:
    """Check the files of a COLMAP model that nerfstudio reads: text before binary, but binary points before text.

    Args:
        model: folder of the model, such as ``sparse/0``.
        images: folder of its images; None skips the check that they exist.
        points: also check the points.

    Raises:
        DataError: names the first unusable entry and its place.
    """
    names = [image.name for image in images_of(model)]
    if images is not None and _SHELL & set(str(images)):
        raise DataError(f"{images} has quotes, $, ` or backslashes in its path; rename the folder that has them")
    for name in names:
        if _SHELL & set(name):
            raise DataError(f"{model.name} has an image named {name!r}; rename it without quotes, $, ` and backslashes")
        if images is not None and not (images / name).is_file():
            raise DataError(
                f"{images / name} does not exist{beside(images / name)}; check --images-path, or remove the view from "
                "the model"
            )
    if points and check_points(model) == 0:
        raise DataError(f"{model} has no points; start without them with colmap --load-3D-points False")


def check_points(model: Path) -> int:
    """Number of points of a model, after a check of their file; ``DataError`` if there is none, or it is damaged."""
    if (model / "points3D.bin").exists():
        return _points_binary(model / "points3D.bin")
    if (model / "points3D.txt").exists():
        return _points_text(model / "points3D.txt")
    raise DataError(f"{model} has no points3D.bin or .txt; add it, or start with colmap --load-3D-points False")


def images_of(model: Path) -> list[ColmapImage]:
    """The images of a model with their cameras, checked; text before binary, as nerfstudio reads them.

    Raises:
        DataError: names the first unusable entry and its place.
    """
    cameras = cameras_of(model)
    text = (model / "cameras.txt").exists()
    images = _images_text(model / "images.txt", cameras) if text else _images_binary(model / "images.bin", cameras)
    if not images:
        raise DataError(f"{model} has no images; the reconstruction failed, run it again")
    return images


def cameras_of(model: Path) -> dict[int, StatedCamera]:
    """The cameras of a model by their numbers, checked; text before binary, as nerfstudio reads them.

    Raises:
        DataError: names the first unusable entry and its place.
    """
    if not model.is_dir():
        raise DataError(
            f"{model} is not a folder; give the folder of the model with colmap --colmap-path (usually sparse/0)"
        )
    if (model / "cameras.txt").exists():
        return _cameras_text(model / "cameras.txt")
    if (model / "cameras.bin").exists():
        return _cameras_binary(model / "cameras.bin")
    raise DataError(
        f"{model} holds neither cameras.bin nor cameras.txt{beside(model / 'cameras.bin')}; give the folder of the "
        "model with --colmap-path"
    )


def num_images(model: Path) -> int:
    """Number of images that a binary COLMAP model states; ``DataError`` if its ``images.bin`` cannot be read."""
    path = model / "images.bin"
    with reading(path, "a complete images.bin"), regular(path).open("rb") as file:
        (count,) = _COUNT.unpack(file.read(_COUNT.size))
    if count * _IMAGE_BYTES > path.stat().st_size:
        raise DataError(f"{path.name} states {count:,} images, more than it can hold; copy or export it again")
    return int(count)


def _check_camera(model: str, width: float, height: float, params: Sequence[float], where: str) -> StatedCamera:
    side(width, "width", where)
    side(height, "height", where)
    names = COLMAP_LENSES[model][1].split()
    if len(params) != len(names):
        raise DataError(f"{where}: {model} has {len(names)} parameters, not {len(params)}; export it again")
    for name, value in zip(names, params, strict=True):
        finite(value, f"parameter {name}", where, positive=name.startswith("f"))
    return StatedCamera(int(width), int(height), *colmap_lens(model, params, where))


def _check_pose(pose: Sequence[float], camera: int, cameras: Collection[int], where: str) -> None:
    for value in pose:
        finite(value, "the pose", where)
    if not abs(math.hypot(*pose[:4]) - 1) < 0.01:
        raise DataError(f"{where}: its quaternion is not of length 1, so it is not a rotation; remove the image")
    if camera not in cameras:
        raise DataError(f"{where}: its camera {camera} is not in the model; export it again")


def _cameras_binary(path: Path) -> dict[int, StatedCamera]:
    file, cameras = _BinaryFile(path), dict[int, StatedCamera]()
    for _ in range(file.count(_CAMERA.size, "cameras")):
        identifier, kind, width, height = file.take(_CAMERA)
        where = f"{path.name}, camera {identifier}"
        model = check_colmap_model(int(kind), where)
        number = len(COLMAP_LENSES[model][1].split())
        camera = _check_camera(model, width, height, file.take(struct.Struct(f"<{number}d")), where)
        if identifier in cameras:
            raise DataError(f"{where}: it is listed twice; export it again")
        cameras[int(identifier)] = camera
    return cameras


def _images_binary(path: Path, cameras: Mapping[int, StatedCamera]) -> list[ColmapImage]:
    file, images = _BinaryFile(path), []
    for _ in range(file.count(_IMAGE_BYTES, "images")):
        identifier, *pose, camera = file.take(_IMAGE)
        _check_pose(pose, int(camera), cameras, f"{path.name}, image {identifier}")
        images.append(ColmapImage(file.text(), tuple(pose), cameras[int(camera)]))
        file.skip(_OBSERVATION * file.count(_OBSERVATION, "observations"))
    return images


def _points_binary(path: Path) -> int:
    file = _BinaryFile(path)
    count = file.count(_POINT.size + _COUNT.size, "points")
    for _ in range(count):
        file.skip(_POINT.size)
        file.skip(_TRACK * file.count(_TRACK, "observations"))
    return count


@contextmanager
def _errors_in_line(path: Path, index: int) -> Iterator[None]:
    """Turn a missing word or an invalid number into a ``DataError`` that names the line."""
    try:
        yield
    except DataError:
        raise
    except (ValueError, IndexError, OverflowError) as error:
        raise DataError(f"{path.name}, line {index + 1} cannot be used ({one_line(error)}); export it again") from error


def _lines(path: Path) -> list[tuple[int, str]]:
    """Lines that are neither empty nor comments, each with its index."""
    return [(i, line) for i, line in enumerate(_all_lines(path)) if line.strip() and not line.strip().startswith("#")]


def _all_lines(path: Path) -> list[str]:
    with reading(path, "UTF-8 text"):
        text = read_bytes(path).decode("utf-8")
    return io.StringIO(text, newline=None).read().split("\n")  # any kind of line end


def _check_count(path: Path, found: int) -> None:
    """Compare with the number that COLMAP states in a comment; a text cut between two lines has no other sign."""
    for line in _all_lines(path):
        stated = re.match(r"# Number of \w+: (\d+)", line)
        if stated and int(stated[1]) != found:
            raise DataError(f"{path.name} states {int(stated[1]):,} entries and has {found:,}; copy or export it again")


def _cameras_text(path: Path) -> dict[int, StatedCamera]:
    cameras: dict[int, StatedCamera] = {}
    for index, line in _lines(path):
        with _errors_in_line(path, index):
            identifier, name, *numbers = line.split()
            where = f"{path.name}, camera {identifier}"
            name = check_colmap_model(name, where)
            width, height = int(numbers[0]), int(numbers[1])
            parameters = [float(value) for value in numbers[2:]]
            cameras[int(identifier)] = _check_camera(name, width, height, parameters, where)
    _check_count(path, len(cameras))
    return cameras


def _images_text(path: Path, cameras: Mapping[int, StatedCamera]) -> list[ColmapImage]:
    lines, images, index = _all_lines(path), list[ColmapImage](), 0
    while index < len(lines):
        line = lines[index].strip()
        index += 1
        if not line or line.startswith("#"):
            continue
        with _errors_in_line(path, index - 1):
            words = line.split()
            pose = tuple(float(word) for word in words[1:8])
            _check_pose(pose, int(words[8]), cameras, f"{path.name}, image {int(words[0])}")
            if len(words) > 10:
                raise DataError(
                    f"{path.name}, line {index}: nerfstudio does not read names with spaces; rename the image"
                )
            images.append(ColmapImage(words[9], pose, cameras[int(words[8])]))
        with _errors_in_line(path, index):
            observations = lines[index].split() if index < len(lines) else []
            if len(observations) % 3:
                raise ValueError("an observation needs three numbers")
            for x, y, point in zip(observations[0::3], observations[1::3], observations[2::3]):
                float(x), float(y), int(point)
        index += 1
    _check_count(path, len(images))
    return images


def _points_text(path: Path) -> int:
    lines = _lines(path)
    for index, line in lines:
        with _errors_in_line(path, index):
            words = line.split()
            int(words[0]), [float(w) for w in words[1:4]], float(words[7]), [int(w) for w in words[8:]]
            if not all(0 <= int(w) <= 255 for w in words[4:7]):
                raise ValueError("a colour must be from 0 to 255")
    _check_count(path, len(lines))
    return len(lines)
