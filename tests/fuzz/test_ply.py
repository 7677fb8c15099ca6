"""Bad .ply files, for the readers of fields and of point clouds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from sundae_ns.gaussians import from_points
from sundae_ns.storage.formats import read_field
from sundae_ns.storage.ply import read_point_cloud, write_ply

HEADER = b"ply\nformat %s 1.0\nelement vertex %s\n%send_header\n"
XYZ = b"property float x\nproperty float y\nproperty float z\n"


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(20, 3, generator=generator)
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    write_ply(path, from_points(points, points, sh_degree=2, num_features=0, generator=generator))
    return path.read_bytes()


def cloud(text: bool) -> Callable[[Path], bytes]:
    def make(path: Path) -> bytes:
        rows = np.zeros(30, dtype=[(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
        rows["x"] = np.linspace(-1, 1, 30)
        PlyData([PlyElement.describe(rows, "vertex")], text=text).write(str(path))
        return path.read_bytes()

    return make


@pytest.mark.seeds(60)
def test_corrupted_field(field: bytes, corrupted: Any, verdict: Any, tmp_path: Path, seed: int) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(corrupted(field, seed))
    verdict(lambda: read_field(path), path.stat().st_size)


@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
@pytest.mark.seeds(30)
def test_corrupted_cloud(corrupted: Any, verdict: Any, tmp_path: Path, seed: int, text: bool) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(corrupted(cloud(text)(path), seed))

    def read() -> None:
        points, rgb = read_point_cloud(path)
        if torch.isfinite(points).all(dim=1).any():
            from_points(points, rgb.float() / 255, sh_degree=1, num_features=0)

    verdict(read, path.stat().st_size)


ODD: dict[str, bytes] = {
    "empty": b"",
    "no header": b"\x00" * 100,
    "end_header alone": b"end_header\n" + b"\x00" * 100,
    "only a header": HEADER % (b"binary_little_endian", b"100", XYZ),
    "a huge count": HEADER % (b"binary_little_endian", b"99999999999999", XYZ) + b"\x00" * 120,
    "a huge count of lists": HEADER % (b"binary_little_endian", b"9999999999", b"property list int float x\n")
    + b"\x00" * 99,
    "a huge list": HEADER % (b"binary_little_endian", b"1", b"property list uint double x\n") + b"\xff" * 4,
    "a huge list in text": HEADER % (b"ascii", b"1", b"property list uint double x\n") + b"4000000000 1\n",
    "a huge count in text": HEADER % (b"ascii", b"99999999999", XYZ) + b"0 0 0\n",
    "no properties": HEADER % (b"binary_little_endian", b"99999999999", b""),
    "a negative count": HEADER % (b"binary_little_endian", b"-5", XYZ),
    "a count that is a word": HEADER % (b"binary_little_endian", b"many", XYZ),
    "x is a list": HEADER % (b"binary_little_endian", b"1", b"property list uchar float x\n" + XYZ[17:]) + b"\x00" * 9,
    "x twice": HEADER % (b"binary_little_endian", b"1", XYZ + XYZ) + b"\x00" * 24,
    "an unknown type": HEADER % (b"binary_little_endian", b"1", b"property quad x\n") + b"\x00" * 24,
    "an unknown format": HEADER % (b"binary_middle_endian", b"1", XYZ) + b"\x00" * 24,
    "words instead of numbers": HEADER % (b"ascii", b"1", XYZ) + b"one two three\n",
    "two numbers instead of three": HEADER % (b"ascii", b"1", XYZ) + b"1 2\n",
    "an endless header": b"ply\nformat ascii 1.0\n" + b"comment la\n" * 30000,
}


@pytest.mark.parametrize("kind", ODD)
@pytest.mark.parametrize("reader", [read_point_cloud, read_field])
def test_other_contents_are_refused(reader: Any, verdict: Any, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "ünï cöde.ply"
    path.write_bytes(ODD[kind])
    assert verdict(lambda: reader(path), len(ODD[kind])) is not None


def test_points_that_are_not_finite_are_dropped(verdict: Any, tmp_path: Path) -> None:
    rows = b"nan 0 0\n0 inf 0\n1e300 0 0\n1 2 3\n"
    path = tmp_path / "a.ply"
    path.write_bytes(HEADER % (b"ascii", b"4", XYZ.replace(b"float", b"double")) + rows)

    def read() -> None:
        points, rgb = read_point_cloud(path)
        field = from_points(points, rgb.float() / 255, sh_degree=0, num_features=0)
        assert torch.equal(field["means"], torch.tensor([[1.0, 2.0, 3.0]]))

    assert verdict(read, path.stat().st_size) is None
