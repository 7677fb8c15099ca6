"""Gaussians in .glb files: exact, upright, and of other programs."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from foreign_files import small_field
from torch import Tensor

import sundae_ns as sn
from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.gltf import EXTENSION, read_glb, semantics, write_glb

THEIRS = Path(__file__).parent / "foreign" / "splat_transform.glb"
"""Five Gaussians of SH degree 2, by ``splat-transform`` 3.7.0 from a .ply with random means of seed 0."""
Document = dict[str, Any]


def parts(path: Path) -> tuple[Document, bytes]:
    data = path.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def put(path: Path, document: object, binary: bytes) -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def close(found: dict[str, Tensor], truth: dict[str, Tensor], tolerance: float = 1e-5) -> None:
    for name in SPLAT_NAMES:
        a, b = found[name], truth[name]
        if name == "quats":
            a, b = (value * value[:, :1].sign() for value in (a, torch.nn.functional.normalize(b)))
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("in_model_frame", [False, True])
def test_up_is_plus_y(tmp_path: Path, in_model_frame: bool) -> None:
    """A point above the origin: along z in the model, along -y elsewhere."""
    gaussians = small_field(3, 0)
    gaussians["means"] = torch.tensor(
        [[0.0, 0, 2], [1, 0, 0], [0, 1, 0]] if in_model_frame else [[0.0, -2, 0], [1, 0, 0], [0, 0, 1]]
    )
    write_glb(tmp_path / "a.glb", gaussians, in_model_frame=in_model_frame)
    document, binary = parts(tmp_path / "a.glb")
    means = np.frombuffer(binary, np.float32, 9).reshape(3, 3)
    np.testing.assert_allclose(means[0], [0, 2, 0], atol=1e-6)
    (accessor,) = (one for one in document["accessors"] if "min" in one)
    assert accessor["min"] == means.min(axis=0).tolist()
    assert accessor["max"] == means.max(axis=0).tolist()


def test_names_and_types_are_those_of_the_extension(tmp_path: Path) -> None:
    gaussians = small_field(4, 3)
    write_glb(tmp_path / "a.glb", gaussians)
    document, binary = parts(tmp_path / "a.glb")
    (primitive,) = document["meshes"][0]["primitives"]
    assert document["extensionsUsed"] == [EXTENSION]
    assert primitive["mode"] == 0
    assert primitive["extensions"][EXTENSION]["kernel"] == "ellipse"
    assert primitive["extensions"][EXTENSION]["colorSpace"] == "srgb_rec709_display"
    assert len(semantics(3)) == 15
    assert {"POSITION", *semantics(3)} < primitive["attributes"].keys()
    kinds = {name: document["accessors"][i]["type"] for name, i in primitive["attributes"].items()}
    assert kinds[f"{EXTENSION}:ROTATION"] == "VEC4"
    assert kinds[f"{EXTENSION}:OPACITY"] == "SCALAR"
    camera = document["bufferViews"][document["accessors"][primitive["attributes"][f"{EXTENSION}:SCALE"]]["bufferView"]]
    widths = np.frombuffer(binary, np.float32, 12, camera["byteOffset"]).reshape(4, 3)
    np.testing.assert_allclose(widths, gaussians["scales"].exp(), rtol=1e-6)
    assert document["buffers"][0]["byteLength"] == len(binary)


def test_a_file_of_another_program() -> None:
    found = read_glb(THEIRS)
    means = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(found[0]["means"], means)
    assert found[0]["features_rest"].shape == (5, 8, 3)
    assert not found[2]
    assert sn.load(THEIRS).num_gaussians == 5


def test_what_another_program_wrote_is_written_alike(tmp_path: Path) -> None:
    found = read_glb(THEIRS)
    write_glb(tmp_path / "a.glb", found[0])
    (ours, data), (document, truth) = parts(tmp_path / "a.glb"), parts(THEIRS)
    names = ours["meshes"][0]["primitives"][0]["attributes"]
    for name, i in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor, camera = document["accessors"][i], document["bufferViews"][document["accessors"][i]["bufferView"]]
        mine = ours["bufferViews"][ours["accessors"][names[name]]["bufferView"]]
        assert accessor["type"] == ours["accessors"][names[name]]["type"], name
        if accessor["componentType"] == 5126:
            count = camera["byteLength"] // 4
            a = np.frombuffer(data, np.float32, count, mine["byteOffset"])
            b = np.frombuffer(truth, np.float32, count, camera["byteOffset"])
            if name == f"{EXTENSION}:ROTATION":  # theirs have the length of the .ply's
                a, b = (q.reshape(-1, 4) * np.sign(q.reshape(-1, 4)[:, :1]) for q in (a, b))
                b = b / np.linalg.norm(b, axis=1, keepdims=True)
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6, err_msg=name)


def test_nodes_place_gaussians(tmp_path: Path) -> None:
    """A node that turns, moves and scales, below another one; and two meshes."""
    gaussians = small_field(50, 1)
    write_glb(tmp_path / "a.glb", gaussians)
    document, binary = parts(tmp_path / "a.glb")
    half = math.sqrt(0.5)
    document["nodes"] = [
        {"children": [1, 2], "translation": [0.0, 3.0, 0.0]},
        {"mesh": 0, "rotation": [0.0, half, 0.0, half], "scale": [2.0, 2.0, 2.0]},
        {"mesh": 0},
    ]
    put(tmp_path / "b.glb", document, binary)
    found = sn.load(tmp_path / "b.glb")
    assert found.num_gaussians == 100
    plain = sn.load(tmp_path / "a.glb")
    # In glTF's axes: turned by 90 degrees about y, twice as large, and 3 up; in the file's, -y is up.
    x, y, z = (plain.gaussians["means"] * torch.tensor([-1.0, -1.0, 1.0])).unbind(dim=1)
    moved = torch.stack([2 * z, 2 * y + 3, -2 * x], dim=1) * torch.tensor([-1.0, -1.0, 1.0])
    first, second = found.gaussians["means"][:50], found.gaussians["means"][50:]
    turned, still = (first, second) if torch.allclose(first, moved, atol=1e-5) else (second, first)
    torch.testing.assert_close(turned, moved, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(still, plain.gaussians["means"] - torch.tensor([0.0, 3.0, 0.0]))


def test_integers_are_normalised(tmp_path: Path) -> None:
    gaussians = small_field(4, 0)
    write_glb(tmp_path / "a.glb", gaussians)
    document, binary = parts(tmp_path / "a.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    opacities = gaussians["opacities"].sigmoid()[:, 0].numpy()
    turns = np.roll(torch.nn.functional.normalize(gaussians["quats"]).numpy(), -1, axis=1)
    turns = np.stack([-turns[:, 1], turns[:, 0], turns[:, 3], -turns[:, 2]], axis=1)  # after half a turn about z
    added = np.rint(65535 * opacities).astype("<u2").tobytes()
    for name, data, kind, component in (
        (f"{EXTENSION}:OPACITY", added, "SCALAR", 5123),
        (f"{EXTENSION}:ROTATION", np.rint(32767 * turns).astype("<i2").tobytes(), "VEC4", 5122),
    ):
        document["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        document["accessors"].append(
            {"bufferView": len(document["bufferViews"]) - 1, "count": 4, "type": kind, "componentType": component}
        )
        document["accessors"][-1]["normalized"] = True
        attributes[name] = len(document["accessors"]) - 1
        binary += data
    document["buffers"][0]["byteLength"] = len(binary)
    put(tmp_path / "b.glb", document, binary)
    close(read_glb(tmp_path / "b.glb")[0], read_glb(tmp_path / "a.glb")[0], 2e-4)


def _in(name: str, **values: object) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        document[name][0].update(values)

    return change


def _splats(**values: object) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        document["meshes"][0]["primitives"][0]["extensions"][EXTENSION].update(values)

    return change


def _without(document: Document) -> None:
    del document["meshes"][0]["primitives"][0]["attributes"][f"{EXTENSION}:SCALE"]


def _mesh(document: Document) -> None:
    document["meshes"][0]["primitives"][0]["extensions"] = {}


HOSTILE: dict[str, tuple[Callable[[Document], object], str]] = {
    "no Gaussians": (_mesh, f"no mesh of its scene has {EXTENSION}"),
    "no widths": (_without, "SCALE"),
    "another kernel": (_splats(kernel="box"), "of another kernel"),
    "compressed": (_splats(extensions={"KHR_gaussian_splatting_compression_spz": {}}), "compressed"),
    "other colours": (_splats(colorSpace="lin_rec709_display"), "lin_rec709_display"),
    "a node below itself": (_in("nodes", children=[0]), "a node below itself"),
    "a node beyond all": (_in("scenes", nodes=[7]), "not that of a glTF scene"),
    "a negative node": (_in("scenes", nodes=[-1]), "-1 is no index"),
    "a mirror": (_in("nodes", scale=[-1, 1, 1]), "mirrors or stretches"),
    "a stretch": (_in("nodes", scale=[1, 2, 1]), "mirrors or stretches"),
    "a matrix of nothing": (_in("nodes", matrix=[0] * 16), "mirrors or stretches"),
    "a matrix of words": (_in("nodes", matrix=["x"] * 16), "not that of a glTF scene"),
    "more rows than bytes": (_in("accessors", count=10**12), "beyond its data"),
    "a stride of nothing": (_in("bufferViews", byteStride=0), "beyond its data"),
    "an offset beyond": (_in("bufferViews", byteOffset=10**9), "beyond its data"),
    "another file": (_in("buffers", uri="../../etc/passwd"), "in another file"),
    "sparse": (_in("accessors", sparse={}), "sparse"),
    "unknown numbers": (_in("accessors", componentType=1), "not that of a glTF scene"),
    "matrices": (_in("accessors", type="MAT4"), "not that of a glTF scene"),
    "no scene": (lambda document: document.pop("scenes"), "not that of a glTF scene"),
    "a scene of words": (lambda document: document.update(scene="x"), "not that of a glTF scene"),
    "extras of words": (lambda document: document["asset"].update(extras="x"), "not that of a glTF scene"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_are_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    write_glb(tmp_path / "a.glb", small_field(4, 1))
    document, binary = parts(tmp_path / "a.glb")
    change, words = HOSTILE[kind]
    change(document)
    put(tmp_path / "a.glb", document, binary)
    with pytest.raises(DataError, match="a.glb") as caught:
        sn.load(tmp_path / "a.glb")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_field_that_does_not_fit(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="up to 3"):
        write_glb(tmp_path / "a.glb", small_field(4, 4))
    with pytest.raises(DataError, match="no Gaussians"):
        write_glb(tmp_path / "a.glb", small_field(0))
    assert not list(tmp_path.iterdir())
