"""COLMAP models, written without COLMAP."""

from __future__ import annotations

import struct
from pathlib import Path


def write_model(
    folder: Path,
    names: list[str],
    size: tuple[int, int],
    *,
    observations: int = 2,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    stray: tuple[int, float] | None = None,
    lenses: list[tuple[int, list[float]]] | None = None,
) -> None:
    """Write a binary COLMAP model: cameras on a line, one point per view.

    Args:
        folder: of the model.
        names: of the images.
        size: width and height of the images, pixels.
        observations: of each image.
        origin: where the model stands.
        stray: index of an image, and how far its camera is moved along x.
        lenses: camera models and their parameters, taken in turns; by default a pinhole.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (width, height), focal = size, 18.0
    lenses = lenses or [(1, [focal, focal, width / 2, height / 2])]
    cameras = struct.pack("<Q", len(lenses))
    for number, (model, params) in enumerate(lenses, start=1):
        cameras += struct.pack(f"<iiQQ{len(params)}d", number, model, width, height, *params)
    images = struct.pack("<Q", len(names))
    points = struct.pack("<Q", len(names))
    for index, name in enumerate(names):
        moved = stray[1] if stray is not None and stray[0] == index else 0.0
        place = [a - b for a, b in zip((0.3 * index + moved, 0.1, 3.0), origin, strict=True)]
        images += struct.pack("<i7di", index + 1, 1, 0, 0, 0, *place, 1 + index % len(lenses)) + name.encode() + b"\0"
        images += struct.pack("<Q", observations) + struct.pack("<ddq", 3.0, 4.0, index) * observations
        point = [a + b for a, b in zip((0.1 * index, 0.2, 0.3), origin, strict=True)]
        points += struct.pack("<Q3d3Bd", index, *point, 10, 20, 30, 0.5)
        points += struct.pack("<Q", 2) + struct.pack("<ii", 1, 0) * 2
    for file, content in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{file}.bin").write_bytes(content)
