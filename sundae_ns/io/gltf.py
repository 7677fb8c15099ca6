"""Gaussians in glTF: binary files (.glb) with Khronos' extension ``KHR_gaussian_splatting``.

    12 bytes   "glTF", u4 2, u4 length of the file
    8 + J      u4 J, "JSON", the document, padded with spaces
    8 + B      u4 B, "BIN\0", the buffer

The document has a node, a mesh and a Gaussian of points. Its attributes are float32 accessors of the buffer: POSITION,
and after the extension's name ROTATION (unit quaternions xyzw), SCALE (widths), OPACITY, and SH_DEGREE_l_COEF_n; and
COLOR_0 in bytes, for programs without the extension. Values are exact. three.js, PlayCanvas and Babylon.js read them.

``asset.extras.sundae_ns``, which other programs ignore, keeps the marks of the scene (``Marks``), such as an offset.

In glTF +y points up. A scene of nerfstudio's model, where z does, is turned to that and says so, and is turned back
when it is read. Other scenes have no known axes; like ``splat-transform`` this module takes the file's -y as up, as in
most .ply files, and turns them about z.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.core.files import replacing
from sundae_ns.core.gaussians import SH_C0, sh_degree
from sundae_ns.io.budget import afford, afford_gaussians, joined, parsed_json
from sundae_ns.io.coordinates import similarity
from sundae_ns.io.ply import LEAST_OPACITY, UNMARKED, Marks, check_gaussians, checked, vector
from sundae_ns.io.spz import decoded

EXTENSION = "KHR_gaussian_splatting"
_SPZ = EXTENSION + "_compression_spz_2"
_INSTANCING, _VISIBILITY = "EXT_mesh_gpu_instancing", "KHR_node_visibility"
_KNOWN = {EXTENSION, _SPZ, _INSTANCING, _VISIBILITY, "KHR_mesh_quantization", "glTF 2.0", "glTF 2"}
_SRGB = "srgb_rec709_display"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_MOST_NODES, _PLACED_AT_ONCE = 10_000, 1000  # nodes of a scene, and instances; transforms that are applied at once
_MOST_BYTES = (1 << 32) - (1 << 20)  # of a buffer: a file states its length in 32 bits, and has a document too
_READ, _PLACE = 1 << 18, 1 << 12  # bytes that take as long as to read a primitive, and as to place it
_TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0  # OpenGL's numbers: types, a target, a mode
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_FROM_MODEL = torch.tensor([[-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])  # its own inverse
_FROM_PLY = torch.tensor([[-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])  # its own inverse
Json = Mapping[str, Any]
Transforms = NDArray[np.float64]
_OURS, _MARKS = "sundae_ns", ("antialiased", "modelFrame", "up", "offset")  # extras of the asset, in the order of Marks


def semantics(degree: int) -> list[str]:
    """Names of the attributes of SH coefficients of degrees 1 to ``degree``, in the order of ``features_rest``."""
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(1, degree + 1) for n in range(2 * d + 1)]


def write_glb(path: Path, params: Mapping[str, Tensor], marks: Marks = UNMARKED) -> None:
    """Write the base colours of Gaussians that ``ply.checked`` accepts as a .glb, atomically."""
    gaussians = similarity(checked(path, params), _FROM_MODEL if marks.in_model_frame else _FROM_PLY, 1.0)
    opacities = gaussians["opacities"].sigmoid()
    colors = torch.cat([SH_C0 * gaussians["features_dc"] + 0.5, opacities], dim=1).clamp(0, 1)
    attributes = {
        "POSITION": gaussians["means"],
        "COLOR_0": (255 * colors).round().to(torch.uint8),
        f"{EXTENSION}:ROTATION": gaussians["quats"].roll(-1, dims=1),
        f"{EXTENSION}:SCALE": gaussians["scales"].exp(),
        f"{EXTENSION}:OPACITY": opacities,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": gaussians["features_dc"],
    }
    rest = gaussians["features_rest"].unbind(dim=1)
    attributes |= dict(zip(semantics(sh_degree(gaussians["features_rest"])), rest, strict=True))
    if (size := sum(value.nbytes for value in attributes.values())) > _MOST_BYTES:
        raise DataError(f"{path} would hold {size:,} bytes, and a .glb at most {_MOST_BYTES:,}; write a .sog or .ply")
    stated = {name: value for name, value in zip(_MARKS, marks, strict=True) if value}
    accessors: list[dict[str, Any]] = []
    buffer_views: list[dict[str, int]] = []
    types = {number: name for name, number in _TYPES.items()}
    for name, value in attributes.items():
        accessor = {"bufferView": len(accessors), "count": len(value), "type": types[value.shape[1]]}
        is_float = value.is_floating_point()
        accessor |= {"componentType": _FLOAT if is_float else _BYTE, "normalized": not is_float}
        if name == "POSITION":  # as glTF demands
            accessor |= {"min": value.amin(dim=0).tolist(), "max": value.amax(dim=0).tolist()}
        accessors.append(accessor)
        start = sum(view["byteLength"] for view in buffer_views)  # a multiple of four bytes
        buffer_views.append({"buffer": 0, "byteOffset": start, "byteLength": value.nbytes, "target": _ARRAY_BUFFER})
    look = {"kernel": "ellipse", "colorSpace": _SRGB, "projection": "perspective", "sortingMethod": "cameraDistance"}
    indices = {name: i for i, name in enumerate(attributes)}
    document = {
        "asset": {"version": "2.0", "generator": "sundae_ns", **({"extras": {_OURS: stated}} if stated else {})},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": indices, "mode": _POINTS, "extensions": {EXTENSION: look}}]}],
        "accessors": accessors,
        "bufferViews": buffer_views,
        "buffers": [{"byteLength": size}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    front = _CHUNK.pack(len(text), _JSON) + text + _CHUNK.pack(size, _BINARY)
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(_HEADER.pack(b"glTF", 2, _HEADER.size + len(front) + size) + front)
        file.writelines(value.contiguous().numpy().data for value in attributes.values())


def read_glb(path: Path) -> tuple[dict[str, Tensor], Marks]:
    """The Gaussians of a .glb of any program, without meshes and cameras beside them. No code in it runs.

    Their means are float64, because nodes may move them far.
    """
    with reading(path, "a complete .glb with Gaussians", remedy="export it again, or as .ply"):
        try:
            document, binary = _chunks(path)
            versions = [document["asset"].get("minVersion", 2.0), str(document["asset"].get("version", 2))[:1]]
            for name in (*document.get("extensionsRequired", []), *(f"glTF {version}" for version in versions)):
                if name not in _KNOWN:
                    raise ValueError(f"it requires {name}, which is not known here")
            stated = [document["asset"].get("extras", {}).get(_OURS, {}).get(name) for name in _MARKS]
            antialiased, in_model_frame = (value is True for value in stated[:2])
            up, offset = (vector(" ".join(map(str, value or ()))) for value in stated[2:])
            parts: list[dict[str, Tensor]] = []
            unpacked = 0  # bytes
            for primitive, transforms in _primitives(document, binary):
                gaussians, marked = _read_primitive(document, binary, primitive)
                antialiased |= marked.antialiased
                unpacked += _READ + len(transforms) * (_PLACE + sum(value.nbytes for value in gaussians.values()))
                afford(unpacked, path.stat().st_size)
                starts = range(_PLACED_AT_ONCE, len(transforms), _PLACED_AT_ONCE)
                parts += [_placed(gaussians, matrices) for matrices in np.split(transforms, starts)]
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            raise ValueError("its JSON is not that of a glTF scene") from error
        if not parts:
            raise ValueError(f"no mesh of its scene has {EXTENSION}")
        marks = Marks(antialiased, in_model_frame, up, offset)
        return similarity(joined(parts, path.stat().st_size), _FROM_MODEL if in_model_frame else _FROM_PLY, 1.0), marks


def _chunks(path: Path) -> tuple[dict[str, Any], memoryview]:
    """The document, and the bytes of the first buffer."""
    data = memoryview(regular(path).read_bytes())
    magic, version, length = _HEADER.unpack_from(data)
    if magic != b"glTF" or version != 2 or length > len(data):
        raise ValueError("its header is not that of a whole glTF 2.0 file")
    chunks = {_BINARY: data[:0]}
    start = _HEADER.size
    while start < length:
        count, kind = _CHUNK.unpack_from(data, start)
        start += _CHUNK.size + count
        if start > length:
            raise ValueError("a chunk of it is cut")
        chunks[kind] = data[start - count : start]
    return parsed_json(bytes(chunks[_JSON])), chunks[_BINARY]


def _primitives(document: Json, binary: memoryview) -> Iterator[tuple[Json, Transforms]]:
    """Primitives with Gaussians that the scene shows, each once, and the transforms of all nodes that show it."""
    nodes = document.get("nodes", [])
    visited: set[int] = set()
    visible: list[tuple[Json, int]] = []  # nodes after their parents, and the positions of these

    def visit(indices: list[Any], parent: int) -> None:
        for index in indices:
            if _index(index) in visited or len(visited) == _MOST_NODES:
                raise ValueError(f"a node has two parents or is below itself, or it has over {_MOST_NODES:,} nodes")
            visited.add(index)
            if nodes[index].get("extensions", {}).get(_VISIBILITY, {}).get("visible") is not False:
                visible.append((nodes[index], parent))

    if "scenes" in document:
        visit(document["scenes"][_index(document.get("scene", 0))].get("nodes", []), -1)
    else:
        children = {index for node in nodes for index in node.get("children", [])}
        visit([index for index in range(len(nodes)) if index not in children], -1)
    for i, (node, _) in enumerate(visible):
        visit(node.get("children", []), i)
    transforms = _local_transforms([node for node, _ in visible]) if visible else np.empty((0, 4, 4))
    by_mesh: dict[int, list[Transforms]] = {}
    instances = 0
    for i, (node, parent) in enumerate(visible):
        transforms[i] = transforms[parent] @ transforms[i] if parent >= 0 else transforms[i]
        if "mesh" in node:
            accessors = node.get("extensions", {}).get(_INSTANCING, {}).get("attributes", {}).items()
            parts = {name.lower(): _values(document, binary, j) for name, j in accessors if not name.startswith("_")}
            instances += max(map(len, parts.values()), default=1)
            if instances > _MOST_NODES or len({*map(len, parts.values())}) > 1:
                raise ValueError(f"its instances of meshes are over {_MOST_NODES:,}, or have unequal accessors")
            of_node = transforms[i] @ _transforms(parts) if parts else transforms[i : i + 1]
            by_mesh.setdefault(_index(node["mesh"]), []).append(of_node)
    for mesh, of_nodes in by_mesh.items():
        for primitive in document["meshes"][mesh]["primitives"]:
            if EXTENSION in primitive.get("extensions", {}):
                yield primitive, np.concatenate(of_nodes)


def _index(value: object) -> int:
    """An index or a count of the document."""
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r} is no index")
    return value


def _local_transforms(nodes: list[Json]) -> Transforms:
    """Transforms ``[N, 4, 4]`` of nodes to the coordinates of their parents."""
    parts = {}
    of_parent: dict[str, list[float]] = {"translation": [0] * 3, "rotation": [0, 0, 0, 1], "scale": [1] * 3}
    for name, usual in (*of_parent.items(), ("matrix", np.eye(4).ravel().tolist())):
        parts[name] = np.array([node.get(name, usual) for node in nodes], np.float64)
        if parts[name].shape[1:] != (len(usual),) or not np.isfinite(parts[name]).all():
            raise ValueError(f"the {name} of a node is not {len(usual)} numbers")
    matrices = parts.pop("matrix").reshape(-1, 4, 4).transpose(0, 2, 1)
    if (matrices[:, 3] != (0, 0, 0, 1)).any():
        raise ValueError("the last row of a node's matrix is not 0 0 0 1: exchange its rows and columns")
    return np.where([[["matrix" in node]] for node in nodes], matrices, _transforms(parts))


def _transforms(parts: Mapping[str, NDArray[Any]]) -> Transforms:
    """Transforms ``[P, 4, 4]`` of translations ``[P, 3]``, rotations xyzw ``[P, 4]`` and scales ``[P, 3]``, if any."""
    transforms = np.tile(np.eye(4), (max(map(len, parts.values()), default=1), 1, 1))
    turns = torch.from_numpy(parts.get("rotation", np.array([[0.0, 0.0, 0.0, 1.0]]))).double()
    transforms[:, :3, :3] = rotation_matrices(turns.roll(1, dims=1)).numpy()
    transforms[:, :3, :3] *= np.asarray(parts.get("scale", np.ones((1, 3))))[:, None, :]
    transforms[:, :3, 3] = parts.get("translation", 0.0)
    return transforms


def _read_primitive(document: Json, binary: memoryview, primitive: Json) -> tuple[dict[str, Tensor], Marks]:
    """The Gaussians of a primitive in its own coordinates, and whether they are marked as antialiased."""
    extension = primitive["extensions"][EXTENSION]
    compressed = extension.get("extensions", {})
    if compressed.keys() == {_SPZ}:  # with the values of the attributes, as CesiumJS reads it
        return decoded(bytes(_view(document, binary, compressed[_SPZ]["bufferView"])), "LUF")
    if compressed or extension.get("kernel", "ellipse") != "ellipse" or primitive.keys() & {"indices", "targets"}:
        raise ValueError(f"its Gaussians are compressed ({', '.join(compressed)}), indexed, or of another kernel")
    if extension.get("colorSpace", _SRGB) != _SRGB:
        raise ValueError(f"its colours are in {extension['colorSpace']!r}")
    attributes = primitive["attributes"]

    def values(name: str) -> Tensor:
        if name not in attributes:
            raise ValueError(f"its Gaussians have no {name}")
        return torch.from_numpy(_values(document, binary, attributes[name]))

    means = values("POSITION")
    degree = int(max(sum(f"{EXTENSION}:SH_DEGREE_" in name for name in attributes) - 1, 0) ** 0.5)  # all, or missing
    afford_gaussians(len(means), (degree + 1) ** 2 - 1, len(binary) // 8)  # accessors may share their bytes
    rest = [values(name) for name in semantics(degree)]
    params = {
        "means": means,
        "scales": values(f"{EXTENSION}:SCALE").log(),
        "quats": values(f"{EXTENSION}:ROTATION").roll(1, dims=1),
        "features_dc": values(f"{EXTENSION}:SH_DEGREE_0_COEF_0"),
        "features_rest": torch.stack(rest, dim=1) if rest else torch.zeros(len(means), 0, 3),
        "opacities": torch.logit(values(f"{EXTENSION}:OPACITY"), eps=LEAST_OPACITY),
    }
    check_gaussians(params, ValueError)
    return params, UNMARKED


def _placed(gaussians: Mapping[str, Tensor], transforms: Transforms) -> dict[str, Tensor]:
    """The Gaussians under each of the transforms ``[P, 4, 4]``, one after the other; means in float64."""
    placed = {**gaussians, "means": gaussians["means"].double()}
    if np.array_equal(transforms, np.eye(4)[None]):
        return placed
    factor = np.cbrt(np.abs(np.linalg.det(transforms[:, :3, :3])))[:, None, None]
    rigid = transforms[:, :3] / np.where(factor > 0, factor, np.nan)
    if not np.allclose(rigid[..., :3] @ rigid[..., :3].transpose(0, 2, 1), np.eye(3), rtol=0, atol=1e-4):
        raise ValueError("a node stretches its Gaussians")
    placed = similarity(placed, torch.from_numpy(rigid), 1.0)
    placed["means"] = placed["means"] * torch.from_numpy(factor)
    placed["scales"] = placed["scales"] + torch.from_numpy(np.log(factor)).float()
    return {name: value.expand(len(rigid), *gaussians[name].shape).flatten(0, 1) for name, value in placed.items()}


def _view(document: Json, binary: memoryview, index: object) -> memoryview:
    """The bytes of a buffer view."""
    view = document["bufferViews"][_index(index)]
    if _index(view.get("buffer", 0)) != 0 or "uri" in document["buffers"][0] or view.get("extensions"):
        raise ValueError("its data are compressed, or in another file")
    start, length = _index(view.get("byteOffset", 0)), _index(view["byteLength"])
    if start + length > len(binary):
        raise ValueError("its accessors reach beyond its data")
    return binary[start : start + length]


def _values(document: Json, binary: memoryview, index: object) -> NDArray[np.float32]:
    """Values of an accessor ``[N, C]``; integers are normalised if it says so."""
    accessor = document["accessors"][_index(index)]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise ValueError("it has sparse or empty accessors")
    data = _view(document, binary, accessor["bufferView"])
    kind, columns = np.dtype(_COMPONENTS[accessor["componentType"]]), _TYPES[accessor["type"]]
    rows = _index(accessor["count"])
    width = kind.itemsize * columns
    stride = _index(document["bufferViews"][accessor["bufferView"]].get("byteStride", width))
    start = _index(accessor.get("byteOffset", 0))
    if (start + (rows - 1) * stride + width if rows else 0) > len(data) or stride < width:
        raise ValueError("its accessors reach beyond its data")
    table: NDArray[Any] = np.ndarray((rows, columns), kind, data, start, (stride, kind.itemsize))
    values = table.astype(np.float32)
    if accessor.get("normalized") is True and kind.kind in "iu":
        values = np.maximum(values / np.float32(np.iinfo(kind).max), -1)
    return values
