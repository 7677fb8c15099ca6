"""Every reader of untrusted files against damage: cut, flipped, replaced, deleted, repeated and huge bytes.

A reader succeeds or fails with a one-line :class:`SundaeError`, within limits of time and memory.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from fields import random_field
from foreign_files import FOREIGN, small_field
from hypothesis import HealthCheck, given, settings
from packed_scenes import header_and_body, sealed
from plyfile import PlyData, PlyElement

from sundae_ns.core.errors import PackError
from sundae_ns.io.formats import read_gaussian_file, read_gaussians, write_for_viewers
from sundae_ns.io.pack.packed_scene import PackedScene, read_scene, write_scene
from sundae_ns.io.ply import read_point_cloud
from sundae_ns.scene.initialization import from_points

Reader = Callable[[Path], Any]
HEADER = b"ply\nformat %s 1.0\nelement vertex %s\n%send_header\n"
XYZ = b"property float x\nproperty float y\nproperty float z\n"


@st.composite
def damage(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """One change of the bytes of a file; half of them are near its start, which holds counts and types."""
    kind = draw(st.sampled_from(["cut", "flip", "replace", "delete", "repeat"]))
    where = draw(st.floats(0, 1, exclude_max=True))
    at_start, length = draw(st.booleans()), draw(st.sampled_from([1, 7, 64, 1000]))
    values = draw(st.sampled_from([b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\0" * 8, b"99999999"]) | st.binary(min_size=1))
    bits = draw(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 7)), min_size=1, max_size=30))

    def change(content: bytes) -> bytes:
        data, size = bytearray(content), min(len(content), 80) if at_start else len(content)
        i = int(where * size)
        if kind == "cut":
            return content[:i]
        if kind == "flip":
            for share, bit in bits:
                data[int(share * size)] ^= 1 << bit
        elif kind == "replace":
            data[i : i + len(values)] = values
        elif kind == "delete":
            del data[i : i + length]
        else:
            data[i:i] = data[i : i + length]
        return bytes(data)

    return change


def scene() -> PackedScene:
    generator = torch.Generator().manual_seed(0)
    head = {"net.weight": torch.randn(3, 4, 1, 1, generator=generator), "net.bias": torch.randn(3, generator=generator)}
    cameras = {
        "poses": torch.eye(4)[None, :3],
        "intrinsics": torch.full((1, 4), 20.0).double(),
        "sizes": torch.full((1, 2), 32),
    }
    return PackedScene(random_field(50, 2, 3), head, cameras, {"model": {"sh_degree": 2}})


def resealed(meta: dict[str, Any], body: bytes) -> bytes:
    """The file with valid checksums of header and sections."""
    offset = 0
    for section in meta["sections"]:
        length = sum(section["parts"])
        section["sha256"] = hashlib.sha256(body[offset : offset + length]).hexdigest()
        offset += length
    return sealed(meta, body)


def unpack(path: Path) -> None:
    gaussians = read_scene(path).gaussians
    assert all(torch.isfinite(value).all() for value in gaussians.values())
    assert len({len(value) for value in gaussians.values()}) == 1


def write_cloud(path: Path, text: bool) -> None:
    rows = np.zeros(30, dtype=[(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    rows["x"] = np.linspace(-1, 1, 30)
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(str(path))


def read_cloud(path: Path) -> None:
    points, rgb = read_point_cloud(path)
    if torch.isfinite(points).all(dim=1).any():
        from_points(points, rgb.float() / 255, sh_degree=1, num_features=0)


def write_checkpoint(path: Path) -> None:
    state = {f"_model.gauss_params.{name}": value for name, value in small_field(20).items()}
    torch.save({"step": 3, "pipeline": state}, path)


READERS: dict[str, tuple[Callable[[Path], Any], Reader]] = {
    **{
        name: (lambda path, write=write: write(path, small_field(60)), read_gaussian_file)
        for name, write in FOREIGN.items()
    },
    **{
        f"a{suffix}": (lambda path: write_for_viewers(path, small_field(60)), read_gaussian_file)
        for suffix in (".spz", ".sog", ".glb")
    },
    "field.ply": (lambda path: FOREIGN["plain.ply"](path, small_field(20)), read_gaussians),
    "cloud.ply": (lambda path: write_cloud(path, text=False), read_cloud),
    "text.ply": (lambda path: write_cloud(path, text=True), read_cloud),
    "a.ckpt": (write_checkpoint, read_gaussians),
    "a.sundae": (lambda path: write_scene(path, scene()), unpack),
}
"""Files by their names: a writer, and the reader that must survive them."""
many = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], bytes]:
    """Contents of a valid file of :data:`READERS`."""
    folder = tmp_path_factory.mktemp("good")

    def content(name: str) -> bytes:
        if not (folder / name).exists():
            READERS[name][0](folder / name)
        return (folder / name).read_bytes()

    return content


@pytest.mark.parametrize("name", READERS)
def test_valid_files_are_read(good: Any, verdict: Any, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(good(name))
    assert verdict(lambda: READERS[name][1](tmp_path / name), len(good(name))) is None


@pytest.mark.parametrize("name", READERS)
@many
@given(change=damage())
def test_damaged_files(good: Any, verdict: Any, tmp_path: Path, name: str, change: Callable[[bytes], bytes]) -> None:
    content, path = change(good(name)), tmp_path / name
    path.write_bytes(content)
    error = verdict(lambda: READERS[name][1](path), len(content))
    if name == "a.sundae":  # every byte is under a checksum
        assert isinstance(error, PackError) or content == good(name)


@many
@given(change=damage(), header=st.booleans())
def test_damaged_packs_with_valid_checksums(
    good: Any, verdict: Any, tmp_path: Path, change: Callable[[bytes], bytes], header: bool
) -> None:
    meta, body = header_and_body(good("a.sundae"))
    if header:
        content = sealed(change(json.dumps(meta).encode()), body)
    else:
        content = resealed(meta, change(body)[: len(body)].ljust(len(body), b"\0"))
    (tmp_path / "a.sundae").write_bytes(content)
    verdict(lambda: unpack(tmp_path / "a.sundae"), len(content))


@many
@given(change=damage())
def test_damaged_pickles_with_valid_checksums(
    good: Any, verdict: Any, tmp_path: Path, change: Callable[[bytes], bytes]
) -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(good("a.ckpt"))) as source, zipfile.ZipFile(out, "w") as target:
        for entry in source.namelist():
            data = source.read(entry)
            target.writestr(entry, change(data) if entry.endswith("data.pkl") else data)
    (tmp_path / "a.ckpt").write_bytes(out.getvalue())
    verdict(lambda: read_gaussians(tmp_path / "a.ckpt"), len(out.getvalue()))


BINARY = b"binary_little_endian"
PLYS: dict[str, bytes] = {
    "empty": b"",
    "no header": b"\x00" * 100,
    "end_header alone": b"end_header\n" + b"\x00" * 100,
    "only a header": HEADER % (BINARY, b"100", XYZ),
    "a huge count": HEADER % (BINARY, b"99999999999999", XYZ) + b"\x00" * 120,
    "a huge count of lists": HEADER % (BINARY, b"9999999999", b"property list int float x\n") + b"\x00" * 99,
    "a huge list": HEADER % (BINARY, b"1", b"property list uint double x\n") + b"\xff" * 4,
    "a huge list in text": HEADER % (b"ascii", b"1", b"property list uint double x\n") + b"4000000000 1\n",
    "a huge count in text": HEADER % (b"ascii", b"99999999999", XYZ) + b"0 0 0\n",
    "no properties": HEADER % (BINARY, b"99999999999", b""),
    "a negative count": HEADER % (BINARY, b"-5", XYZ),
    "a count that is a word": HEADER % (BINARY, b"many", XYZ),
    "x is a list": HEADER % (BINARY, b"1", b"property list uchar float x\n" + XYZ[17:]) + b"\x00" * 9,
    "x twice": HEADER % (BINARY, b"1", XYZ + XYZ) + b"\x00" * 24,
    "an unknown type": HEADER % (BINARY, b"1", b"property quad x\n") + b"\x00" * 24,
    "an unknown format": HEADER % (b"binary_middle_endian", b"1", XYZ) + b"\x00" * 24,
    "words instead of numbers": HEADER % (b"ascii", b"1", XYZ) + b"one two three\n",
    "two numbers instead of three": HEADER % (b"ascii", b"1", XYZ) + b"1 2\n",
    "an endless header": b"ply\nformat ascii 1.0\n" + b"comment la\n" * 30000,
}


@pytest.mark.parametrize("kind", PLYS)
@pytest.mark.parametrize("reader", [read_point_cloud, read_gaussians])
def test_odd_plys_are_refused(reader: Reader, verdict: Any, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "ünï cöde.ply"
    path.write_bytes(PLYS[kind])
    assert verdict(lambda: reader(path), len(PLYS[kind])) is not None


PACKS: dict[str, bytes] = {
    "empty": b"",
    "magic alone": b"\x89SUNDAE\n",
    "a checkpoint": b"PK\x03\x04" + bytes(200),
    "no JSON": sealed(b"{", b""),
    "deep JSON": sealed(b"[" * 100_000, b""),
    "a list": sealed(b"[]", b""),
    "not a number": sealed(b'{"sections": [], "Gaussians": NaN}', b""),
    "invalid UTF-8": sealed(b"\xff\xfe", b""),
    "a long header": b"\x89SUNDAE\n" + struct.pack("<II", 3, 2**32 - 1) + bytes(132),
}


@pytest.mark.parametrize("kind", PACKS)
def test_odd_packs_are_refused(kind: str, verdict: Any, tmp_path: Path) -> None:
    path = tmp_path / "ünï cöde.sundae"
    path.write_bytes(PACKS[kind])
    assert isinstance(verdict(lambda: read_scene(path), len(PACKS[kind])), PackError)


@pytest.mark.parametrize(("stated", "words"), [(1 << 27, "would unpack to"), (1 << 20, "cannot be decompressed")])
def test_bombs_are_refused_before_they_unpack(stated: int, words: str, good: Any, verdict: Any, tmp_path: Path) -> None:
    deflate = zlib.compressobj(9, wbits=-15)
    stream = deflate.compress(bytes(1 << 27)) + deflate.flush()
    meta, body = header_and_body(good("a.sundae"))
    meta["sections"].append({"name": "a", "dtype": "|u1", "shape": [stated], "parts": [len(stream)]})
    content = resealed(meta, body + stream)
    (tmp_path / "a.sundae").write_bytes(content)
    error = verdict(lambda: read_scene(tmp_path / "a.sundae"), len(content))
    assert isinstance(error, PackError)
    assert words in str(error)


def test_a_few_constant_planes_cannot_fill_the_memory(verdict: Any, tmp_path: Path) -> None:
    """Every section is within its limit, but the field that they describe is not."""
    n, path = 200_000, tmp_path / "a.sundae"
    write_scene(path, PackedScene({k: v[:1].expand(n, *v.shape[1:]) for k, v in scene().gaussians.items()}))
    meta, body = header_and_body(path.read_bytes())
    padding = meta["sections"].pop()
    assert padding["name"] == "padding"
    content = resealed(meta, body[: len(body) - sum(padding["parts"])])
    path.write_bytes(content)
    assert "would unpack to" in str(verdict(lambda: read_scene(path), len(content)))


def test_points_that_are_not_finite_are_dropped(verdict: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    rows = b"nan 0 0\n0 inf 0\n1e300 0 0\n1 2 3\n"
    path.write_bytes(HEADER % (b"ascii", b"4", XYZ.replace(b"float", b"double")) + rows)

    def read() -> None:
        points, rgb = read_point_cloud(path)
        gaussians = from_points(points, rgb.float() / 255, sh_degree=0, num_features=0)
        assert torch.equal(gaussians["means"], torch.tensor([[1.0, 2.0, 3.0]]))

    assert verdict(read, path.stat().st_size) is None
