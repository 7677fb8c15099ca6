"""Gaussians in glTF: binary files (.glb) with Khronos' extension ``KHR_gaussian_splatting``.

    12 bytes   "glTF", u4 2, u4 length of the file
    8 + J      u4 J, "JSON", the document, padded with spaces
    8 + B      u4 B, "BIN\0", the buffer

The document has a node, a mesh and a Gaussian of points. Its attributes are float32 accessors of the buffer: POSITION,
and after the extension's name ROTATION (unit quaternions xyzw), SCALE (widths), OPACITY, and SH_DEGREE_l_COEF_n; and
COLOR_0 in bytes, for programs without the extension. Values are exact. three.js, PlayCanvas and Babylon.js read them.

In glTF +y points up. A scene of nerfstudio's model, where z does, is turned to that and says so, and is turned back
when it is read. Other scenes have no known axes; like ``splat-transform`` this module takes the file's -y as up, as in
most .ply files, and turns them about z.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.core.errors import reading, regular
from sundae_ns.core.files import replacing
from sundae_ns.core.gaussians import SH_C0, sh_degree
from sundae_ns.io.coordinates import similarity
from sundae_ns.io.ply import LEAST_OPACITY, MAX_SH_DEGREE, check_gaussians, checked

EXTENSION = "KHR_gaussian_splatting"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_MOST_JSON = 1 << 24
_MOST_NODES = 10_000
_POINTS, _VERTICES = 0, 34962
_FLOAT, _UNSIGNED_BYTE = 5126, 5121
_NUMBERS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_FROM_MODEL = torch.tensor([[-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])  # its own inverse
_FROM_PLY = torch.tensor([[-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])  # its own inverse
_OURS, _MODEL_FRAME, _ANTIALIASED = "sundae_ns", "modelFrame", "antialiased"


class GltfScene(NamedTuple):
    """The Gaussians of a .glb: a field, float32 on the CPU, and the marks of :func:`write_glb`."""

    params: dict[str, Tensor]
    antialiased: bool
    in_model_frame: bool


def semantics(degree: int) -> list[str]:
    """Names of the attributes of SH coefficients of degrees 1 to ``degree``, in the order of ``features_rest``."""
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(1, degree + 1) for n in range(2 * d + 1)]


def write_glb(
    path: Path, params: Mapping[str, Tensor], *, antialiased: bool = False, in_model_frame: bool = False
) -> None:
    """Write the base colours of a finite field of SH degree at most 3 as a .glb, atomically.

    ``in_model_frame`` says that it is in the coordinates of nerfstudio's model.

    Raises:
        DataError: the field has no Gaussians, an SH degree above 3, or wrong shapes.
        StorageError: the disk is full or not writable.
    """
    gaussians = similarity(checked(path, params), _FROM_MODEL if in_model_frame else _FROM_PLY, 1.0)
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
    marks = {_MODEL_FRAME: in_model_frame, _ANTIALIASED: antialiased}
    document, binary = _document(attributes, {name: True for name, true in marks.items() if true})
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(_HEADER.pack(b"glTF", 2, _HEADER.size + 2 * _CHUNK.size + len(document) + len(binary)))
        file.write(_CHUNK.pack(len(document), _JSON) + document)
        file.write(_CHUNK.pack(len(binary), _BINARY))
        file.write(binary)


def _document(attributes: Mapping[str, Tensor], marks: Mapping[str, bool]) -> tuple[bytes, bytearray]:
    """The JSON and the buffer of a file with one Gaussian of these attributes."""
    accessors: list[dict[str, Any]] = []
    buffer_views: list[dict[str, int]] = []
    buffer = bytearray()
    for name, value in attributes.items():
        data = value.contiguous().numpy().tobytes()  # a multiple of four bytes
        kind = next(kind for kind, number in _NUMBERS.items() if number == value.shape[1])
        accessor: dict[str, Any] = {"bufferView": len(buffer_views), "count": len(value), "type": kind}
        if value.is_floating_point():
            accessor["componentType"] = _FLOAT
        else:
            accessor |= {"componentType": _UNSIGNED_BYTE, "normalized": True}
        if name == "POSITION":  # as glTF demands
            accessor |= {"min": value.amin(dim=0).tolist(), "max": value.amax(dim=0).tolist()}
        accessors.append(accessor)
        buffer_views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(data), "target": _VERTICES})
        buffer += data
    callback = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: callback},
    }
    document = {
        "asset": {"version": "2.0", "generator": "sundae_ns", **({"extras": {_OURS: marks}} if marks else {})},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": buffer_views,
        "buffers": [{"byteLength": len(buffer)}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    return text + b" " * (-len(text) % 4), buffer


def read_glb(path: Path) -> GltfScene:
    """Read the Gaussians of a .glb of any program; meshes and cameras beside them are left out. No code in it runs.

    Raises:
        DataError: the file is missing, damaged, no .glb, or holds no Gaussians in a form that this module reads.
    """
    with reading(path, "a complete .glb with Gaussians", remedy="export it again, or as .ply"):
        document, binary = _chunks(path)
        try:
            return _scene_of(document, binary)
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            raise ValueError("its JSON is not that of a glTF scene") from error


def _scene_of(document: Mapping[str, Any], binary: memoryview) -> GltfScene:
    parts = [_read_gaussian(document, binary, *placed) for placed in _placed(document)]
    if not parts:
        raise ValueError(f"no mesh of its scene has {EXTENSION}")
    if len({part["features_rest"].shape[1] for part in parts}) > 1:
        raise ValueError("its Gaussians have different SH degrees")
    params = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    marks = document["asset"].get("extras", {}).get(_OURS, {})
    in_model_frame = marks.get(_MODEL_FRAME) is True
    params = similarity(params, _FROM_MODEL if in_model_frame else _FROM_PLY, 1.0)
    return GltfScene(params, marks.get(_ANTIALIASED) is True, in_model_frame)


def _chunks(path: Path) -> tuple[dict[str, Any], memoryview]:
    """The document, and the bytes of the first buffer."""
    size = regular(path).stat().st_size
    with path.open("rb") as file:
        magic, version, length = _HEADER.unpack(file.read(_HEADER.size))
        if magic != b"glTF" or version != 2 or length > size:
            raise ValueError("its header is not that of a whole glTF 2.0 file")
        count, kind = _CHUNK.unpack(file.read(_CHUNK.size))
        if kind != _JSON or count > min(_MOST_JSON, size):
            raise ValueError("its first chunk is no JSON of at most 16 MiB")
        document = json.loads(file.read(count))
        rest = file.read(length - file.tell())
    if not isinstance(document, dict):
        raise ValueError("its JSON is no object")
    if not rest:
        return document, memoryview(b"")
    count, kind = _CHUNK.unpack(rest[: _CHUNK.size])
    if kind != _BINARY or count > len(rest) - _CHUNK.size:
        raise ValueError("its binary chunk is cut")
    return document, memoryview(rest)[_CHUNK.size : _CHUNK.size + count]


def _placed(document: Mapping[str, Any]) -> Iterator[tuple[Mapping[str, Any], NDArray[np.float64]]]:
    """Gaussians of the scene with Gaussians, and the transform ``[4, 4]`` of the nodes above them."""
    nodes = document.get("nodes", [])
    scene = document["scenes"][document.get("scene", 0)]
    waiting = [(index, np.eye(4)) for index in scene.get("nodes", [])]
    for _ in range(_MOST_NODES):
        if not waiting:
            return
        index, above = waiting.pop()
        node = nodes[_index(index)]
        transform = above @ _matrix(node)
        waiting += [(child, transform) for child in node.get("children", [])]
        if "mesh" in node:
            for primitive in document["meshes"][_index(node["mesh"])]["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    yield primitive, transform
    raise ValueError(f"its scene has more than {_MOST_NODES:,} nodes, or a node below itself")


def _index(value: object) -> int:
    """An index or a count of the document."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{value!r} is no index")
    return value


def _matrix(node: Mapping[str, Any]) -> NDArray[np.float64]:
    """A node's transform ``[4, 4]``."""

    def numbers(name: str, default: tuple[int, ...]) -> NDArray[np.float64]:
        values = node.get(name, default)
        plain = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
        if len(values) != len(default) or not plain:
            raise TypeError(f"{values!r} are not {len(default)} numbers")
        return np.array(values, dtype=np.float64)

    if "matrix" in node:
        return numbers("matrix", (0,) * 16).reshape(4, 4).T
    turn = torch.from_numpy(numbers("rotation", (0, 0, 0, 1))).roll(1)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrices(turn[None])[0].numpy() * numbers("scale", (1, 1, 1))
    matrix[:3, 3] = numbers("translation", (0, 0, 0))
    return matrix


def _read_gaussian(
    document: Mapping[str, Any], binary: memoryview, primitive: Mapping[str, Any], transform: NDArray[np.float64]
) -> dict[str, Tensor]:
    """The field of one Gaussian of the document, where its nodes put it."""
    stated = primitive["extensions"][EXTENSION]
    if stated.get("extensions") or stated.get("kernel", "ellipse") != "ellipse":
        raise ValueError("its Gaussians are compressed, or of another kernel")
    if stated.get("colorSpace", "srgb_rec709_display") != "srgb_rec709_display":
        raise ValueError(f"its colours are in {stated['colorSpace']!r}")
    attributes = primitive["attributes"]

    def values(name: str) -> Tensor:
        if name not in attributes:
            raise ValueError(f"its Gaussians have no {name}")
        return torch.from_numpy(_values(document, binary, attributes[name]))

    means = values("POSITION")
    degree = max((d for d in range(MAX_SH_DEGREE + 1) if set(semantics(d)) <= attributes.keys()), default=0)
    rest = [values(name) for name in semantics(degree)]
    params = {
        "means": means,
        "scales": values(f"{EXTENSION}:SCALE").log(),
        "quats": values(f"{EXTENSION}:ROTATION").roll(1, dims=1),
        "features_dc": values(f"{EXTENSION}:SH_DEGREE_0_COEF_0"),
        "features_rest": torch.stack(rest, dim=1) if rest else torch.zeros(len(means), 0, 3),
        "opacities": torch.logit(values(f"{EXTENSION}:OPACITY"), eps=LEAST_OPACITY),
    }
    check_gaussians(params)
    if np.array_equal(transform, np.eye(4)):
        return params
    linear = transform[:3, :3]
    factor = np.cbrt(np.linalg.det(linear))
    is_similarity = np.allclose(linear @ linear.T, factor**2 * np.eye(3), rtol=1e-4)
    if not (math.isfinite(factor) and factor > 0 and is_similarity):
        raise ValueError("a node mirrors or stretches its Gaussians")
    rigid = np.concatenate([linear / factor, transform[:3, 3:] / factor], axis=1)
    return similarity(params, torch.from_numpy(rigid).float(), float(factor))


def _values(document: Mapping[str, Any], binary: memoryview, index: object) -> NDArray[np.float32]:
    """Values of an accessor ``[N, C]``; integers are normalised if it says so."""
    accessor = document["accessors"][_index(index)]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise ValueError("it has sparse or empty accessors")
    camera = document["bufferViews"][_index(accessor["bufferView"])]
    if _index(camera.get("buffer", 0)) != 0 or "uri" in document["buffers"][0] or camera.get("extensions"):
        raise ValueError("its data are compressed, or in another file")
    kind, columns = np.dtype(_COMPONENTS[accessor["componentType"]]), _NUMBERS[accessor["type"]]
    rows, start = _index(accessor["count"]), _index(camera.get("byteOffset", 0))
    stride = _index(camera.get("byteStride", kind.itemsize * columns))
    inside = _index(accessor.get("byteOffset", 0))
    used = inside + (rows - 1) * stride + kind.itemsize * columns if rows else 0
    beyond = used > _index(camera["byteLength"]) or start + camera["byteLength"] > len(binary)
    if beyond or stride < kind.itemsize * columns:
        raise ValueError("its accessors reach beyond its data")
    table: NDArray[Any] = np.ndarray((rows, columns), kind, binary, start + inside, (stride, kind.itemsize))
    values = table.astype(np.float32)
    if accessor.get("normalized") is True and kind.kind in "iu":
        values = np.maximum(values / np.float32(np.iinfo(kind).max), -1)
    return values
