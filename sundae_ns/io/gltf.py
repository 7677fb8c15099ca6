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
from typing import Any

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
_MOST_NODES = 10_000
_TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_FROM_MODEL = torch.tensor([[-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])  # its own inverse
_FROM_PLY = torch.tensor([[-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])  # its own inverse
_OURS, _MODEL_FRAME, _ANTIALIASED = "sundae_ns", "modelFrame", "antialiased"


def semantics(degree: int) -> list[str]:
    """Names of the attributes of SH coefficients of degrees 1 to ``degree``, in the order of ``features_rest``."""
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(1, degree + 1) for n in range(2 * d + 1)]


def write_glb(
    path: Path, params: Mapping[str, Tensor], *, antialiased: bool = False, in_model_frame: bool = False
) -> None:
    """Write the base colours of finite Gaussians of SH degree at most 3 as a .glb, atomically.

    ``in_model_frame`` says that they are in the coordinates of nerfstudio's model.

    Raises:
        DataError: there are no Gaussians, an SH degree above 3, or wrong shapes.
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
    document, binary = _document(attributes, {name: True for name, applies in marks.items() if applies})
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(_HEADER.pack(b"glTF", 2, _HEADER.size + 2 * _CHUNK.size + len(document) + len(binary)))
        for kind, content in ((_JSON, document), (_BINARY, binary)):
            file.write(_CHUNK.pack(len(content), kind))
            file.write(content)


def _document(attributes: Mapping[str, Tensor], marks: Mapping[str, bool]) -> tuple[bytes, bytearray]:
    """The JSON and the buffer of a file with one primitive of these attributes."""
    accessors: list[dict[str, Any]] = []
    buffer_views: list[dict[str, int]] = []
    buffer = bytearray()
    types = {number: name for name, number in _TYPES.items()}
    for name, value in attributes.items():
        data = value.contiguous().numpy().tobytes()  # a multiple of four bytes
        accessor: dict[str, Any] = {
            "bufferView": len(buffer_views),
            "count": len(value),
            "type": types[value.shape[1]],
            **({"componentType": 5126} if value.is_floating_point() else {"componentType": 5121, "normalized": True}),
        }
        if name == "POSITION":  # as glTF demands
            accessor |= {"min": value.amin(dim=0).tolist(), "max": value.amax(dim=0).tolist()}
        accessors.append(accessor)
        # The target is ARRAY_BUFFER.
        buffer_views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(data), "target": 34962})
        buffer += data
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "mode": 0,  # points
        "extensions": {EXTENSION: extension},
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


def read_glb(path: Path) -> tuple[dict[str, Tensor], bool, bool]:
    """Read the Gaussians of a .glb of any program; meshes and cameras beside them are left out. No code in it runs.

    Returns:
        Gaussians, float32 on the CPU, and the marks of :func:`write_glb`, antialiased and in the model's frame.

    Raises:
        DataError: the file is missing, damaged, no .glb, or holds no Gaussians in a form that this module reads.
    """
    with reading(path, "a complete .glb with Gaussians", remedy="export it again, or as .ply"):
        document, binary = _chunks(path)
        try:
            parts = [_read_primitive(document, binary, *found) for found in _primitives(document)]
            marks = document["asset"].get("extras", {}).get(_OURS, {})
            antialiased, in_model_frame = (marks.get(name) is True for name in (_ANTIALIASED, _MODEL_FRAME))
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            raise ValueError("its JSON is not that of a glTF scene") from error
        if not parts:
            raise ValueError(f"no mesh of its scene has {EXTENSION}")
        if len({part["features_rest"].shape[1] for part in parts}) > 1:
            raise ValueError("its Gaussians have different SH degrees")
        params = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        return similarity(params, _FROM_MODEL if in_model_frame else _FROM_PLY, 1.0), antialiased, in_model_frame


def _chunks(path: Path) -> tuple[dict[str, Any], memoryview]:
    """The document, and the bytes of the first buffer."""
    size = regular(path).stat().st_size
    with path.open("rb") as file:
        magic, version, length = _HEADER.unpack(file.read(_HEADER.size))
        if magic != b"glTF" or version != 2 or length > size:
            raise ValueError("its header is not that of a whole glTF 2.0 file")
        count, kind = _CHUNK.unpack(file.read(_CHUNK.size))
        if kind != _JSON or count > min(1 << 24, size):
            raise ValueError("its first chunk is no JSON of at most 16 MiB")
        document = json.loads(file.read(count))
        rest = memoryview(file.read(length - file.tell()))
    if not isinstance(document, dict):
        raise ValueError("its JSON is no object")
    if not rest:
        return document, rest
    count, kind = _CHUNK.unpack(rest[: _CHUNK.size])
    if kind != _BINARY or count > len(rest) - _CHUNK.size:
        raise ValueError("its binary chunk is cut")
    return document, rest[_CHUNK.size : _CHUNK.size + count]


def _primitives(document: Mapping[str, Any]) -> Iterator[tuple[Mapping[str, Any], NDArray[np.float64]]]:
    """Primitives of the scene with Gaussians, and the transform ``[4, 4]`` of the nodes above them."""
    scene = document["scenes"][document.get("scene", 0)]
    waiting = [(index, np.eye(4)) for index in scene.get("nodes", [])]
    for _ in range(_MOST_NODES):
        if not waiting:
            return
        index, above = waiting.pop()
        node = document["nodes"][_index(index)]
        transform = above @ _matrix(node)
        waiting += [(child, transform) for child in node.get("children", [])]
        primitives = document["meshes"][_index(node["mesh"])]["primitives"] if "mesh" in node else []
        for primitive in primitives:
            if EXTENSION in primitive.get("extensions", {}):
                yield primitive, transform
    raise ValueError(f"its scene has more than {_MOST_NODES:,} nodes, or a node below itself")


def _index(value: object) -> int:
    """An index or a count of the document."""
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r} is no index")
    return value


def _matrix(node: Mapping[str, Any]) -> NDArray[np.float64]:
    """A node's transform ``[4, 4]``."""

    def numbers(name: str, default: tuple[int, ...]) -> NDArray[np.float64]:
        values = node.get(name, default)
        if len(values) != len(default) or not all(type(value) in (int, float) for value in values):
            raise TypeError(f"{values!r} are not {len(default)} numbers")
        return np.array(values, dtype=np.float64)

    if "matrix" in node:
        return numbers("matrix", (0,) * 16).reshape(4, 4).T
    turn = torch.from_numpy(numbers("rotation", (0, 0, 0, 1))).roll(1)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrices(turn[None])[0].numpy() * numbers("scale", (1, 1, 1))
    matrix[:3, 3] = numbers("translation", (0, 0, 0))
    return matrix


def _read_primitive(
    document: Mapping[str, Any], binary: memoryview, primitive: Mapping[str, Any], transform: NDArray[np.float64]
) -> dict[str, Tensor]:
    extension = primitive["extensions"][EXTENSION]
    if extension.get("extensions") or extension.get("kernel", "ellipse") != "ellipse":
        raise ValueError("its Gaussians are compressed, or of another kernel")
    if extension.get("colorSpace", "srgb_rec709_display") != "srgb_rec709_display":
        raise ValueError(f"its colours are in {extension['colorSpace']!r}")
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
    buffer_view = document["bufferViews"][_index(accessor["bufferView"])]
    if _index(buffer_view.get("buffer", 0)) != 0 or "uri" in document["buffers"][0] or buffer_view.get("extensions"):
        raise ValueError("its data are compressed, or in another file")
    kind, columns = np.dtype(_COMPONENTS[accessor["componentType"]]), _TYPES[accessor["type"]]
    rows, start, length = map(_index, (accessor["count"], buffer_view.get("byteOffset", 0), buffer_view["byteLength"]))
    width = kind.itemsize * columns
    stride, inside = _index(buffer_view.get("byteStride", width)), _index(accessor.get("byteOffset", 0))
    used = inside + (rows - 1) * stride + width if rows else 0
    if used > length or start + length > len(binary) or stride < width:
        raise ValueError("its accessors reach beyond its data")
    table: NDArray[Any] = np.ndarray((rows, columns), kind, binary, start + inside, (stride, kind.itemsize))
    values = table.astype(np.float32)
    if accessor.get("normalized") is True and kind.kind in "iu":
        values = np.maximum(values / np.float32(np.iinfo(kind).max), -1)
    return values
