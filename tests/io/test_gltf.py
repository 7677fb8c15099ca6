"""Gaussians in .glb files: exact, upright, and of other programs."""

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from documents import GONE, put
from fields import assert_close, assert_moved
from foreign_files import small_field, spz
from limits import refused

import sundae_ns as sn
from sundae_ns.core.errors import DataError
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.gltf import EXTENSION, read_glb, semantics, write_glb
from sundae_ns.io.ply import Marks
from sundae_ns.io.spz import read_spz

THEIRS = Path(__file__).parent / "foreign" / "splat_transform.glb"
"""Five Gaussians of SH degree 2, by ``splat-transform`` 3.7.0 from a .ply with random means of seed 0."""
PRIMITIVE = "meshes/0/primitives/0"
SHARED = f"{PRIMITIVE}/attributes/{EXTENSION}"
SPLAT, SPZ_2 = f"{PRIMITIVE}/extensions/{EXTENSION}", f"{EXTENSION}_compression_spz_2"


def parts(path):
    data = path.read_bytes()
    (length,) = struct.unpack("<I", data[12:16])
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def write(path, document, binary=b""):
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def written(path, gaussians, **marks):
    write_glb(path, gaussians, Marks(**marks))
    return parts(path)


def floats(document, binary, accessor):
    """The values of an accessor ``[N, C]``."""
    view = document["bufferViews"][accessor["bufferView"]]
    return np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(accessor["count"], -1)


@pytest.mark.parametrize("in_model_frame", [False, True])
def test_up_is_plus_y(tmp_path, in_model_frame):
    """A point above the origin: along z in the model, along -y elsewhere."""
    gaussians = small_field(3, 0)
    gaussians["means"][0] = torch.tensor([0.0, 0, 2] if in_model_frame else [0.0, -2, 0])
    document, binary = written(tmp_path / "a.glb", gaussians, in_model_frame=in_model_frame)
    (accessor,) = (one for one in document["accessors"] if "min" in one)
    means = floats(document, binary, accessor)
    np.testing.assert_allclose(means[0], [0, 2, 0], atol=1e-6)
    assert accessor["min"] == means.min(axis=0).tolist()
    assert accessor["max"] == means.max(axis=0).tolist()


def test_a_file_of_another_program_is_read_and_written_alike(tmp_path):
    found, (_, in_model_frame, *_) = read_glb(THEIRS)
    torch.testing.assert_close(found["means"].float(), torch.rand(5, 3, generator=torch.Generator().manual_seed(0)))
    assert (found["features_rest"].shape, in_model_frame) == ((5, 8, 3), False)
    (ours, data), (theirs, truth) = written(tmp_path / "a.glb", found), parts(THEIRS)
    assert all(ours[name] == theirs[name] for name in ("extensionsUsed", "scene", "scenes", "nodes", "meshes"))
    assert ours["buffers"][0]["byteLength"] == len(data)
    for mine, accessor in zip(ours["accessors"], theirs["accessors"], strict=True):
        assert mine["type"] == accessor["type"]
        if accessor["componentType"] == 5126:
            a, b = floats(ours, data, mine), floats(theirs, truth, accessor)
            if mine["type"] == "VEC4":  # rotations; theirs have the length of the .ply's
                a, b = (q * np.sign(q[:, :1]) / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    assert len(semantics(3)) == 15


def test_nodes_place_gaussians(tmp_path):
    """A node that turns and scales, below one that moves."""
    document, binary = written(tmp_path / "a.glb", small_field(50, 1))
    plain = read_glb(tmp_path / "a.glb")[0]
    half = math.sqrt(0.5)
    node = {"mesh": 0, "rotation": [0.0, half, 0.0, half], "scale": [2.0, 2.0, 2.0]}
    document["nodes"] = [{"children": [1], "translation": [0.0, 3.0, 0.0]}, node]
    write(tmp_path / "a.glb", document, binary)
    # In glTF's axes: turned by 90 degrees about y, twice as large, and 3 up; in the file's, -y is up.
    flip = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    turn = flip @ torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]) @ flip
    assert_moved(read_glb(tmp_path / "a.glb")[0], plain, turn, torch.tensor([0.0, -1.5, 0.0]), 2.0)


def test_integers_are_normalised(tmp_path):
    document, binary = written(tmp_path / "a.glb", small_field(4, 0))
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    for name, kind, component, most in (("OPACITY", "<u2", 5123, 65535), ("ROTATION", "<i2", 5122, 32767)):
        values = floats(document, binary, document["accessors"][attributes[f"{EXTENSION}:{name}"]])
        binary = added(document, binary, np.rint(most * values).astype(kind), component, normalized=True)
        attributes[f"{EXTENSION}:{name}"] = len(document["accessors"]) - 1
    write(tmp_path / "b.glb", document, binary)
    found, truth = (read_glb(tmp_path / name)[0] for name in ("b.glb", "a.glb"))
    assert_close(found, truth, {"opacities": 1e-5, "quats": 1e-4})


FAR = [5e5 + 1 / 8, 30, -4e6 + 1 / 16]
HIDDEN = {"extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2]}
TWICE = [{"mesh": 0}, {"mesh": 0, "translation": [1, 0, 0]}]
ABOVE = {"children": [0], "translation": [0, 5, 0]}
UNUSUAL = {
    "all nodes that are no child": ({"scenes": GONE, "scene": GONE, "nodes": [{"mesh": 0}, ABOVE]}, [[0, 5, 0]]),
    "hidden children of a node": ({"nodes": [{"mesh": 0, "children": [1]}, HIDDEN, {"mesh": 0}]}, [[0, 0, 0]]),
    "survey coordinates": ({"nodes/0/translation": FAR}, [FAR]),
    "one mesh twice": ({"nodes": TWICE, "scenes": [{"nodes": [0, 1]}]}, [[0, 0, 0], [1, 0, 0]]),
}


@pytest.mark.parametrize("kind", UNUSUAL)
def test_places_of_unusual_scenes(tmp_path, kind):
    document, binary = written(tmp_path / "a.glb", small_field(9, 1))
    plain = read_glb(tmp_path / "a.glb")[0]["means"]
    changes, places = UNUSUAL[kind]
    put(document, changes)
    write(tmp_path / "a.glb", document, binary)
    moves = torch.tensor(places, dtype=torch.float64) * torch.tensor([-1.0, -1.0, 1.0])
    expected = torch.cat([plain + move for move in moves])
    torch.testing.assert_close(read_glb(tmp_path / "a.glb")[0]["means"], expected, rtol=0, atol=1e-9)


def added(document, binary, values, component, **accessor):
    """The buffer with values ``[N, C]``, of which the last accessor tells."""
    kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes})
    about = {"bufferView": len(document["bufferViews"]) - 1, "count": len(values), "componentType": component}
    document["accessors"].append({**about, "type": kind, **accessor})
    document["buffers"][0]["byteLength"] = len(binary) + values.nbytes
    return binary + values.tobytes()


def test_instances_are_nodes_of_their_own(tmp_path):
    document, binary = written(tmp_path / "a.glb", small_field(20, 2))
    half = math.sqrt(0.5)
    turns = [[0, half, 0, half], [0, 0, 0, 1], [half, half, 0, 0]]
    placed = {"TRANSLATION": [[1, 2, 3], [0, 0, 0], [4, 0, 0]], "ROTATION": turns}
    placed["SCALE"] = [[2] * 3, [1, 1, -1], [0.5] * 3]
    outer = {"rotation": [half, 0, 0, half], "translation": [0, 7, 0]}
    nodes = [{name.lower(): placed[name][i] for name in placed} | {"mesh": 0} for i in range(3)]
    write(tmp_path / "b.glb", {**document, "nodes": [{**outer, "children": [1, 2, 3]}, *nodes]}, binary)
    for values in placed.values():
        binary = added(document, binary, np.array(values, "<f4"), 5126)
    instancing = {"attributes": {name: len(document["accessors"]) - 3 + i for i, name in enumerate(placed)}}
    document["nodes"] = [{**outer, "mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": instancing}}]
    document["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    write(tmp_path / "a.glb", document, binary)
    instances, separate = read_glb(tmp_path / "a.glb")[0], read_glb(tmp_path / "b.glb")[0]
    assert len(instances["means"]) == 60
    assert_close(instances, separate, dict.fromkeys(SPLAT_NAMES, 1e-5))
    document["accessors"][-1]["count"] = 1
    write(tmp_path / "a.glb", document, binary)
    refused(read_glb, tmp_path / "a.glb", "or have unequal accessors")


def test_a_spz_inside(tmp_path):
    field = small_field(30, 1)
    content = spz(field, 2, antialiased=True)
    (tmp_path / "a.spz").write_bytes(content)
    document, binary = written(tmp_path / "a.glb", field)
    compressed = {
        f"{SPLAT}/extensions": {SPZ_2: {"bufferView": 0}},
        "accessors": [{"componentType": 5126, "count": 30, "type": "VEC3"} for _ in document["accessors"]],
        "bufferViews": [{"buffer": 0, "byteLength": len(content)}],
        "extensionsRequired": [EXTENSION, SPZ_2],
    }
    put(document, compressed)
    write(tmp_path / "b.glb", document, content)
    (found, (antialiased, *_)), (plain, _) = read_glb(tmp_path / "b.glb"), read_spz(tmp_path / "a.spz")
    assert antialiased
    torch.testing.assert_close(found["means"].float(), plain["means"] * torch.tensor([-1.0, -1.0, 1.0]))
    torch.testing.assert_close(found["opacities"], plain["opacities"])


def copies(count, nodes):
    return {
        "meshes/0/primitives": lambda primitives: primitives * count,
        "nodes": [{"mesh": 0}] * nodes,
        "scenes": [{"nodes": list(range(nodes))}],
    }


HOSTILE = {
    "no Gaussians": ({f"{PRIMITIVE}/extensions": {}}, f"no mesh of its scene has {EXTENSION}"),
    "no widths": ({f"{SHARED}:SCALE": GONE}, "SCALE"),
    "another kernel": ({f"{SPLAT}/kernel": "box"}, "of another kernel"),
    "compressed": ({f"{SPLAT}/extensions": {"KHR_gaussian_splatting_compression_spz": {}}}, "compression_spz"),
    "no SPZ": ({f"{SPLAT}/extensions": {SPZ_2: {"bufferView": 0}}}, "missing|header"),
    "a part of the harmonics": ({f"{SHARED}:SH_DEGREE_1_COEF_2": GONE}, "have no .*DEGREE_1_COEF_2"),
    "SH degree 5": ({f"{PRIMITIVE}/attributes": lambda given: given | dict.fromkeys(semantics(5), 0)}, "35 SH"),
    "a later version": ({"asset/minVersion": "2.1"}, "it requires glTF 2.1"),
    "another version": ({"asset/version": "3.0"}, "it requires glTF 3"),
    "some of its Gaussians": ({f"{PRIMITIVE}/indices": 0}, "Gaussians are .* indexed"),
    "a negative scene": ({"scene": -1}, "-1 is no index"),
    "nothing shown": ({"nodes": [{"children": [1], **HIDDEN}, {"mesh": 0}]}, "no mesh of its scene has"),
    "an unknown requirement": ({"extensionsRequired": ["KHR_new"]}, "it requires KHR_new"),
    "children without end": ({"nodes/0/children": [0] * 30_000}, "two parents"),
    "a chain of nodes": ({"nodes": [{"children": [i + 1]} for i in range(20_000)]}, "over 10,000 nodes"),
    "a primitive 1,000 times": (copies(1000, 1), "would unpack to"),
    "a primitive 100 times in 2,000 nodes": (copies(100, 2000), "would unpack to"),
    "other colours": ({f"{SPLAT}/colorSpace": "lin_rec709_display"}, "lin_rec709_display"),
    "a negative node": ({"scenes/0/nodes": [-1]}, "-1 is no index"),
    "a node beyond all": ({"scenes/0/nodes": [7]}, "not that of a glTF scene"),
    "a stretch": ({"nodes/0/scale": [1, 2, 1]}, "a node stretches"),
    "a small stretch": ({"nodes/0/scale": [1e-6, 2e-6, 1e-6]}, "a node stretches"),
    "a matrix by rows": ({"nodes/0/matrix": [1, 0, 0, 5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "last row of a node's"),
    "a matrix of words": ({"nodes/0/matrix": ["x"] * 16}, "could not convert string"),
    "a matrix of NaN": ({"nodes/0/matrix": [math.nan] * 16}, "the matrix of a node is not 16 numbers"),
    "a short translation": ({"nodes/0/translation": [1]}, "the translation of a node is not 3 numbers"),
    "more rows than bytes": ({"accessors/0/count": 10**12}, "beyond its data"),
    "a stride of nothing": ({"bufferViews/0/byteStride": 0}, "beyond its data"),
    "an offset beyond": ({"bufferViews/0/byteOffset": 10**9}, "beyond its data"),
    "another file": ({"buffers/0/uri": "../../etc/passwd"}, "in another file"),
    "sparse": ({"accessors/0/sparse": {}}, "sparse"),
    "matrices": ({"accessors/0/type": "MAT4"}, "not that of a glTF scene"),
    "a scene of words": ({"scene": "x"}, "'x' is no index"),
    "extras of words": ({"asset/extras": "x"}, "not that of a glTF scene"),
}
TEXTS = {
    b"[" * 999_999: "recursion",
    b'{"a":' + b"9" * 5000 + b"}": "digits",
    b"[]": "no object",
    b'{"a":"' + bytes(9 << 20): "8,388,608",
    b"{}": "not that of",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files_are_refused_in_one_line(tmp_path, kind):
    document, binary = written(tmp_path / "a.glb", small_field(4, 1))
    changes, words = HOSTILE[kind]
    put(document, changes)
    write(tmp_path / "a.glb", document, binary)
    refused(sn.load, tmp_path / "a.glb", f"a.glb.*({words})")


@pytest.mark.parametrize("text", TEXTS, ids=TEXTS.values())
def test_odd_documents_are_refused_in_one_line(tmp_path, text):
    write(tmp_path / "a.glb", text)
    refused(sn.load, tmp_path / "a.glb", TEXTS[text])


def test_accessors_that_share_their_bytes_are_refused_before_they_grow(tmp_path):
    """A byte is a number of 59 attributes of a Gaussian."""
    document, _ = written(tmp_path / "a.glb", small_field(4, 3))
    for accessor in document["accessors"]:
        accessor.update(bufferView=0, componentType=5120, count=1 << 20)
    document["bufferViews"][0].update(byteOffset=0, byteLength=1 << 22)
    write(tmp_path / "a.glb", document, bytes(1 << 22))
    refused(sn.load, tmp_path / "a.glb", "would unpack to|none is finite")


def test_a_field_that_does_not_fit(tmp_path, monkeypatch):
    monkeypatch.setattr("sundae_ns.io.gltf._MOST_BYTES", 1000)
    for n, degree, words in ((4, 4, "up to 3"), (18, 0, "would hold 1,080 bytes, and a .glb at most 1,000; write a")):
        with pytest.raises(DataError, match=words):
            write_glb(tmp_path / "a.glb", small_field(n, degree))
    assert not list(tmp_path.iterdir())
