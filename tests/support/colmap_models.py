"""COLMAP models, written without COLMAP."""

from __future__ import annotations

import struct
from pathlib import Path


def write_model(folder: Path, names: list[str], size: tuple[int, int], *, observations: int = 2) -> None:
    """Write a binary COLMAP model: cameras on a line, one point per view."""
    folder.mkdir(parents=True, exist_ok=True)
    (width, height), focal = size, 18.0
    cameras = struct.pack("<QiiQQ4d", 1, 1, 1, width, height, focal, focal, width / 2, height / 2)
    images = struct.pack("<Q", len(names))
    points = struct.pack("<Q", len(names))
    for index, name in enumerate(names):
        images += struct.pack("<i7di", index + 1, 1, 0, 0, 0, 0.3 * index, 0.1, 3.0, 1) + name.encode() + b"\0"
        images += struct.pack("<Q", observations) + struct.pack("<ddq", 3.0, 4.0, index) * observations
        points += struct.pack("<Q3d3Bd", index, 0.1 * index, 0.2, 0.3, 10, 20, 30, 0.5)
        points += struct.pack("<Q", 2) + struct.pack("<ii", 1, 0) * 2
    for file, content in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{file}.bin").write_bytes(content)
