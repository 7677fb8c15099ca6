"""Gaussians in .glb files: exact, upright, and of other programs."""

import json
import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from foreign_files import small_field, spz
from limits import verdict

import sundae_ns as sn
from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.gltf import EXTENSION, read_glb, semantics, write_glb
from sundae_ns.io.spz import read_spz

THEIRS = Path(__file__).parent / "foreign" / "splat_transform.glb"
"""Five Gaussians of SH degree 2, by ``splat-transform`` 3.7.0 from a .ply with random means of seed 0."""
Document = dict[str, Any]


def parts(path):
    data = path.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def put(path, document, binary):
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def close(found, truth, tolerance=1e-5):
    for name in SPLAT_NAMES:
        a, b = found[name], truth[name]
        if name == "quats":
            a, b = (value * value[:, :1].sign() for value in (a, torch.nn.functional.normalize(b)))
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("in_model_frame", [False, True])
def test_up_is_plus_y(tmp_path, in_model_frame):
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


def test_names_and_types_are_those_of_the_extension(tmp_path):
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


def test_a_file_of_another_program():
    found = read_glb(THEIRS)
    means = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(found[0]["means"].float(), means)
    assert found[0]["features_rest"].shape == (5, 8, 3)
    assert not found[2]
    assert sn.load(THEIRS).num_gaussians == 5


def test_what_another_program_wrote_is_written_alike(tmp_path):
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


def test_nodes_place_gaussians(tmp_path):
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


def test_integers_are_normalised(tmp_path):
    gaussians = small_field(4, 0)
    write_glb(tmp_path / "a.glb", gaussians)
    document, binary = parts(tmp_path / "a.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    opacities = gaussians["opacities"].sigmoid()[:, 0].numpy()
    turns = np.roll(torch.nn.functional.normalize(gaussians["quats"]).numpy(), -1, axis=1)
    turns = np.stack([-turns[:, 1], turns[:, 0], turns[:, 3], -turns[:, 2]], axis=1)  # after half a turn about z
    for name, values, component in (
        (f"{EXTENSION}:OPACITY", np.rint(65535 * opacities[:, None]).astype("<u2"), 5123),
        (f"{EXTENSION}:ROTATION", np.rint(32767 * turns).astype("<i2"), 5122),
    ):
        binary = added(document, binary, values, component, normalized=True)
        attributes[name] = len(document["accessors"]) - 1
    put(tmp_path / "b.glb", document, binary)
    close(read_glb(tmp_path / "b.glb")[0], read_glb(tmp_path / "a.glb")[0], 2e-4)


def _in(name, **values):
    def change(document):
        document[name][0].update(values)

    return change


def _splat(document):
    return document["meshes"][0]["primitives"][0]["extensions"][EXTENSION]


def _hidden(document):
    document["nodes"] = [{"mesh": 0, "children": [1]}, {"extensions": {"KHR_node_visibility": {"visible": False}}}]
    document["nodes"][1]["children"] = [2]
    document["nodes"].append({"mesh": 0})


def _no_scenes(document):
    del document["scenes"], document["scene"]
    document["nodes"] = [{"mesh": 0}, {"children": [0], "translation": [0, 5, 0]}]


def _twice(document):
    document.update(nodes=[{"mesh": 0}, {"mesh": 0, "translation": [1, 0, 0]}], scenes=[{"nodes": [0, 1]}])


FAR = [5e5 + 1 / 8, 30, -4e6 + 1 / 16]
UNUSUAL = {
    "no scenes: all nodes that are no child": (_no_scenes, [[0, 5, 0]]),
    "a hidden node, whose children are hidden": (_hidden, [[0, 0, 0]]),
    "survey coordinates": (_in("nodes", translation=FAR), [FAR]),
    "one mesh twice": (_twice, [[0, 0, 0], [1, 0, 0]]),
}


@pytest.mark.parametrize("kind", UNUSUAL)
def test_places_of_unusual_scenes(tmp_path, kind):
    write_glb(tmp_path / "a.glb", small_field(9, 1))
    document, binary = parts(tmp_path / "a.glb")
    plain = read_glb(tmp_path / "a.glb")[0]["means"]
    UNUSUAL[kind][0](document)
    put(tmp_path / "a.glb", document, binary)
    moves = torch.tensor(UNUSUAL[kind][1], dtype=torch.float64) * torch.tensor([-1.0, -1.0, 1.0])
    expected = torch.cat([plain + move for move in moves])
    torch.testing.assert_close(read_glb(tmp_path / "a.glb")[0]["means"], expected, rtol=0, atol=1e-9)


def added(document, binary, values, component, **accessor):
    """The buffer with values ``[N, C]``, of which the last accessor tells."""
    kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes}
    document["bufferViews"].append(view)
    about = {"bufferView": len(document["bufferViews"]) - 1, "count": len(values), "componentType": component}
    document["accessors"].append({**about, "type": kind, **accessor})
    document["buffers"][0]["byteLength"] = len(binary) + values.nbytes
    return binary + values.tobytes()


def test_instances_are_nodes_of_their_own(tmp_path):
    """Each shows what a node with its translation, rotation and scale shows."""
    write_glb(tmp_path / "a.glb", small_field(20, 2))
    document, binary = parts(tmp_path / "a.glb")
    half = math.sqrt(0.5)
    turns = [[0, half, 0, half], [0, 0, 0, 1], [half, half, 0, 0]]
    placed = {
        "TRANSLATION": [[1, 2, 3], [0, 0, 0], [4, 0, 0]],
        "ROTATION": turns,
        "SCALE": [[2] * 3, [1, 1, -1], [0.5] * 3],
    }
    outer = {"rotation": [half, 0, 0, half], "translation": [0, 7, 0]}
    nodes = [{name.lower(): placed[name][i] for name in placed} | {"mesh": 0} for i in range(3)]
    put(tmp_path / "b.glb", {**document, "nodes": [{**outer, "children": [1, 2, 3]}, *nodes]}, binary)
    for values in placed.values():
        binary = added(document, binary, np.array(values, "<f4"), 5126)
    first = len(document["accessors"]) - 3
    instancing = {"attributes": {name: first + i for i, name in enumerate(placed)}}
    document["nodes"] = [{**outer, "mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": instancing}}]
    document["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    put(tmp_path / "a.glb", document, binary)
    instances, separate = read_glb(tmp_path / "a.glb")[0], read_glb(tmp_path / "b.glb")[0]
    assert len(instances["means"]) == 60
    close(instances, separate)


def test_a_spz_inside(tmp_path):
    field = small_field(30, 1)
    content = spz(field, 2, antialiased=True)
    (tmp_path / "a.spz").write_bytes(content)
    write_glb(tmp_path / "a.glb", field)
    document, binary = parts(tmp_path / "a.glb")
    _splat(document)["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    document["accessors"] = [{"componentType": 5126, "count": 30, "type": "VEC3"} for _ in document["accessors"]]
    document["bufferViews"] = [{"buffer": 0, "byteLength": len(content)}]
    document["extensionsRequired"] = [EXTENSION, "KHR_gaussian_splatting_compression_spz_2"]
    put(tmp_path / "b.glb", document, content)
    found, antialiased, _ = read_glb(tmp_path / "b.glb")
    assert antialiased
    means = read_spz(tmp_path / "a.spz")[0]["means"] * torch.tensor([-1.0, -1.0, 1.0])
    torch.testing.assert_close(found["means"].float(), means)
    torch.testing.assert_close(found["opacities"], read_spz(tmp_path / "a.spz")[0]["opacities"])


def _splats(**values):
    return lambda document: _splat(document).update(values)


def _primitives(count, nodes=1):
    def change(document):
        document["meshes"][0]["primitives"] *= count
        document["nodes"] = [{"mesh": 0}] * nodes
        document["scenes"] = [{"nodes": list(range(nodes))}]

    return change


def _chain(document):
    document["nodes"] = [{"children": [i + 1]} for i in range(200_000)] + [{"mesh": 0}]


def _without(document):
    del document["meshes"][0]["primitives"][0]["attributes"][f"{EXTENSION}:SCALE"]


def _mesh(document):
    document["meshes"][0]["primitives"][0]["extensions"] = {}


HOSTILE = {
    "no Gaussians": (_mesh, f"no mesh of its scene has {EXTENSION}"),
    "no widths": (_without, "SCALE"),
    "another kernel": (_splats(kernel="box"), "of another kernel"),
    "compressed": (_splats(extensions={"KHR_gaussian_splatting_compression_spz": {}}), "compression_spz"),
    "no SPZ": (_splats(extensions={"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}), "missing|header"),
    "an unknown requirement": (lambda document: document.update(extensionsRequired=["KHR_new"]), "it requires KHR_new"),
    "a requirement of words": (lambda document: document.update(extensionsRequired=3), "not that of a glTF scene"),
    "a node 9,999 times": (_in("scenes", nodes=[0] * 9999), "two parents"),
    "a node twice a child": (lambda document: document.update(nodes=[{"children": [1, 1]}, {}]), "two parents"),
    "children without end": (_in("nodes", children=[0] * 300_000), "two parents"),
    "half a million nodes": (_primitives(1, 500_000), "over 10,000 nodes"),
    "a chain of nodes": (_chain, "over 10,000 nodes"),
    "a primitive 4,000 times": (_primitives(4000), "would unpack to"),
    "a primitive 1,000 times in 9,000 nodes": (_primitives(1000, 9000), "would unpack to"),
    "other colours": (_splats(colorSpace="lin_rec709_display"), "lin_rec709_display"),
    "a node below itself": (_in("nodes", children=[0]), "is below itself"),
    "a node beyond all": (_in("scenes", nodes=[7]), "not that of a glTF scene"),
    "a negative node": (_in("scenes", nodes=[-1]), "-1 is no index"),
    "a stretch": (_in("nodes", scale=[1, 2, 1]), "a node stretches"),
    "a small stretch": (_in("nodes", scale=[1e-6, 2e-6, 1e-6]), "a node stretches"),
    "a matrix of nothing": (_in("nodes", matrix=[0] * 16), "a node stretches"),
    "a matrix of words": (_in("nodes", matrix=["x"] * 16), "could not convert string"),
    "a matrix of NaN": (_in("nodes", matrix=[math.nan] * 16), "the matrix of a node is not 16 numbers"),
    "a short translation": (_in("nodes", translation=[1]), "the translation of a node is not 3 numbers"),
    "more rows than bytes": (_in("accessors", count=10**12), "beyond its data"),
    "a stride of nothing": (_in("bufferViews", byteStride=0), "beyond its data"),
    "an offset beyond": (_in("bufferViews", byteOffset=10**9), "beyond its data"),
    "another file": (_in("buffers", uri="../../etc/passwd"), "in another file"),
    "sparse": (_in("accessors", sparse={}), "sparse"),
    "unknown numbers": (_in("accessors", componentType=1), "not that of a glTF scene"),
    "matrices": (_in("accessors", type="MAT4"), "not that of a glTF scene"),
    "no scene": (lambda document: document.update(scenes=[]), "not that of a glTF scene"),
    "a scene of words": (lambda document: document.update(scene="x"), "not that of a glTF scene"),
    "extras of words": (lambda document: document["asset"].update(extras="x"), "not that of a glTF scene"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_are_refused_in_one_line(tmp_path, kind):
    write_glb(tmp_path / "a.glb", small_field(4, 1))
    document, binary = parts(tmp_path / "a.glb")
    change, words = HOSTILE[kind]
    change(document)
    put(tmp_path / "a.glb", document, binary)
    error = verdict(lambda: sn.load(tmp_path / "a.glb"), (tmp_path / "a.glb").stat().st_size)
    assert isinstance(error, DataError)
    assert "a.glb" in str(error)
    assert re.search(words, str(error)), error


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"[" * 999_999, "recursion"),
        (b'{"a":' + b"9" * 5000 + b"}", "digits"),
        (b"[]", "no object"),
        (b'{"a":"' + bytes(17 << 20), "16,777,216"),
        (b"{}", "not that of"),
    ],
)
def test_odd_documents_are_refused_in_one_line(tmp_path, text, words):
    put(tmp_path / "a.glb", text, b"")
    error = verdict(lambda: sn.load(tmp_path / "a.glb"), len(text))
    assert re.search(words, str(error)), error


def test_accessors_that_share_their_bytes_are_refused_before_they_grow(tmp_path):
    """A byte is a number of 59 attributes of a Gaussian."""
    write_glb(tmp_path / "a.glb", small_field(4, 3))
    document, _ = parts(tmp_path / "a.glb")
    for accessor in document["accessors"]:
        accessor.update(bufferView=0, componentType=5120, count=1 << 20)
    document["bufferViews"][0].update(byteOffset=0, byteLength=1 << 22)
    put(tmp_path / "a.glb", document, bytes(1 << 22))
    error = verdict(lambda: sn.load(tmp_path / "a.glb"), 1 << 22)
    assert "would unpack to" in str(error) or "none is finite" in str(error)


def test_a_field_that_does_not_fit(tmp_path):
    with pytest.raises(DataError, match="up to 3"):
        write_glb(tmp_path / "a.glb", small_field(4, 4))
    with pytest.raises(DataError, match="no Gaussians"):
        write_glb(tmp_path / "a.glb", small_field(0))
    assert not list(tmp_path.iterdir())
