"""Bad packed scenes: corrupted, corrupted with valid checksums, decompression bombs, and contradictory headers."""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from sundae_ns.errors import PackError
from sundae_ns.gaussians import from_points
from sundae_ns.storage.pack import PackConfig, PackedScene, read_scene, write_scene

Json = dict[str, Any]


def scene() -> PackedScene:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(50, 3, generator=generator)
    field = from_points(points, points, sh_degree=2, num_features=3, generator=generator)
    field["features_rest"] = torch.randn(50, 8, 3, generator=generator)
    head = {"net.weight": torch.randn(3, 4, 1, 1, generator=generator), "net.bias": torch.randn(3, generator=generator)}
    cameras = {
        "poses": torch.eye(4)[None, :3],
        "intrinsics": torch.full((1, 4), 20.0).double(),
        "sizes": torch.full((1, 2), 32),
    }
    return PackedScene(field, head, cameras, {"model": {"sh_degree": 2}})


def packed(folder: Path, config: PackConfig) -> bytes:
    write_scene(folder / "a.sundae", scene(), config)
    return (folder / "a.sundae").read_bytes()


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return packed(tmp_path_factory.mktemp("packs"), PackConfig())


def parts(content: bytes) -> tuple[Json, bytes]:
    (length,) = struct.unpack("<I", content[12:16])
    return json.loads(content[48 : 48 + length]), content[48 + length :]


def sealed(meta: bytes, body: bytes) -> bytes:
    """A file with this header and body, and a valid checksum of the header."""
    return b"\x89SUNDAE\n" + struct.pack("<II", 3, len(meta)) + hashlib.sha256(meta).digest() + meta + body


def resealed(meta: Json, body: bytes) -> bytes:
    """The file with valid checksums of header and sections."""
    offset = 0
    for section in meta["sections"]:
        length = sum(section["parts"])
        section["sha256"] = hashlib.sha256(body[offset : offset + length]).hexdigest()
        offset += length
    return sealed(json.dumps(meta).encode(), body)


def judged(verdict: Any, path: Path, content: bytes) -> Any:
    path.write_bytes(content)
    return verdict(lambda: check_field(read_scene(path)), len(content))


def check_field(unpacked: PackedScene) -> None:
    assert all(torch.isfinite(value).all() for value in unpacked.field.values())
    assert len({len(value) for value in unpacked.field.values()}) == 1


def test_a_valid_file_is_read(good: bytes, verdict: Any, tmp_path: Path) -> None:
    assert judged(verdict, tmp_path / "a.sundae", good) is None
    assert judged(verdict, tmp_path / "a.sundae", resealed(*parts(good))) is None


@pytest.mark.seeds(60)
def test_corrupted(good: bytes, corrupted: Any, verdict: Any, tmp_path: Path, seed: int) -> None:
    content = corrupted(good, seed)
    error = judged(verdict, tmp_path / "a.sundae", content)
    assert isinstance(error, PackError) or content == good


@pytest.mark.seeds(60)
def test_corrupted_with_valid_checksums(good: bytes, corrupted: Any, verdict: Any, tmp_path: Path, seed: int) -> None:
    meta, body = parts(good)
    changed = corrupted(body, seed)[: len(body)]
    judged(verdict, tmp_path / "a.sundae", resealed(meta, changed + bytes(len(body) - len(changed))))


@pytest.mark.seeds(60)
def test_corrupted_header_with_valid_checksums(
    good: bytes, corrupted: Any, verdict: Any, tmp_path: Path, seed: int
) -> None:
    meta, body = parts(good)
    judged(verdict, tmp_path / "a.sundae", sealed(corrupted(json.dumps(meta).encode(), seed), body))


def section(meta: Json, name: str) -> Json:
    return next(entry for entry in meta["sections"] if entry["name"] == name)


def change(path: str, value: Any) -> Callable[[Json], None]:
    """Set one value of the header. ``path`` is dotted keys; after a leading colon the first names a section."""

    def apply(meta: Json) -> None:
        *keys, last = path.split(".")
        place: Any = section(meta, keys.pop(0)[1:]) if path.startswith(":") else meta
        for key in keys:
            place = place[key]
        place[int(last) if isinstance(place, list) else last] = value

    return apply


LIES: dict[str, Callable[[Json], None]] = {
    "a billion primitives": change("primitives", 10**9),
    "no primitives": change("primitives", 0),
    "half a primitive": change("primitives", 0.5),
    "true primitives": change("primitives", True),
    "no attributes": change("attributes", 3),
    "an attribute of another codec": change("attributes.scales.codec", "pickle"),
    "too many bits": change("attributes.means.bits", 200),
    "an infinite step": change("attributes.opacities.step", 1e308),
    "a huge whole number": change("attributes.opacities.step", 10**4000),
    "a word for a number": change("attributes.opacities.step", "nan"),
    "empty blocks": change("attributes.means.block", 0),
    "a huge shape": change(":opacities/levels.shape", [2**27]),
    "a shape that overflows": change(":opacities/levels.shape", [2**27, 2**27, 2**27]),
    "a negative length": change(":opacities/levels.parts.0", -5),
    "a huge length": change(":opacities/levels.parts.0", 2**50),
    "no parts": change(":opacities/levels.parts", []),
    "a dtype of objects": change(":opacities/levels.dtype", "|O"),
    "a dtype of another width": change(":opacities/levels.dtype", "<f8"),
    "a name twice": change(":opacities/levels.name", "scales/levels"),
    "sections that are numbers": change("sections", [1, None, []]),
    "no sections": change("sections", {}),
    "a head of another shape": change("attributes.head.tensors", [["a", [3, 5, 1, 1]], ["b", [3]]]),
    "a head without shape": change("attributes.head.tensors", "all"),
    "a huge head": change("attributes.head.tensors", [["a", [2**27, 2**27]]]),
}


@pytest.mark.parametrize("lie", LIES)
def test_contradictory_headers_are_refused(lie: str, verdict: Any, tmp_path: Path) -> None:
    meta, body = parts(packed(tmp_path, PackConfig()))
    LIES[lie](meta)
    text = json.dumps(meta).encode()
    assert isinstance(judged(verdict, tmp_path / "a.sundae", sealed(text, body)), PackError)


ODD: dict[str, bytes] = {
    "empty": b"",
    "magic alone": b"\x89SUNDAE\n",
    "a checkpoint": b"PK\x03\x04" + bytes(200),
    "no JSON": sealed(b"{", b""),
    "deep JSON": sealed(b"[" * 100_000, b""),
    "a list": sealed(b"[]", b""),
    "not a number": sealed(b'{"sections": [], "primitives": NaN}', b""),
    "invalid UTF-8": sealed(b"\xff\xfe", b""),
    "a long header": b"\x89SUNDAE\n" + struct.pack("<II", 3, 2**32 - 1) + bytes(132),
}


@pytest.mark.parametrize("kind", ODD)
def test_other_contents_are_refused(kind: str, verdict: Any, tmp_path: Path) -> None:
    assert isinstance(judged(verdict, tmp_path / "ünï cöde.sundae", ODD[kind]), PackError)


@pytest.mark.parametrize("stated", ["true size", "small"])
def test_bombs_are_refused_before_they_unpack(stated: str, good: bytes, verdict: Any, tmp_path: Path) -> None:
    size = 1 << 27
    deflate = zlib.compressobj(9, wbits=-15)
    frame = deflate.compress(bytes(size)) + deflate.flush()
    shape = [size if stated == "true size" else 1 << 20]
    meta, body = parts(good)
    meta["sections"].append({"name": "a", "dtype": "|u1", "shape": shape, "parts": [len(frame)]})
    error = judged(verdict, tmp_path / "a.sundae", resealed(meta, body + frame))
    assert isinstance(error, PackError)
    assert ("would unpack to" if stated == "true size" else "cannot be decompressed") in str(error)


def test_a_few_constant_planes_cannot_fill_the_memory(verdict: Any, tmp_path: Path) -> None:
    """Every section is within its limit, but the field that they describe is not."""
    n = 200_000
    field = {k: v[:1].expand(n, *v.shape[1:]) for k, v in scene().field.items()}
    write_scene(tmp_path / "a.sundae", PackedScene(field))
    meta, body = parts((tmp_path / "a.sundae").read_bytes())
    padding = meta["sections"].pop()
    assert padding["name"] == "padding"
    body = body[: len(body) - sum(padding["parts"])]
    error = judged(verdict, tmp_path / "a.sundae", resealed(meta, body))
    assert "would unpack to" in str(error)
