"""Primitives in glTF: binary files (.glb) with Khronos' extension ``KHR_gaussian_splatting``.

three.js, PlayCanvas and Babylon.js read them. Values are exact: centres, widths and opacities after activation,
unit quaternions (xyzw) and SH coefficients in float32. Programs without the extension show coloured points.

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

from sundae_ns.errors import DataError, reading, regular
from sundae_ns.gaussians.parameters import SH_C0, sh_degree
from sundae_ns.storage.atomic import replacing
from sundae_ns.storage.compressed_ply import LEAST_OPACITY
from sundae_ns.storage.ply import check_field
from sundae_ns.storage.transform import similarity

EXTENSION = "KHR_gaussian_splatting"
MAX_SH_DEGREE = 3
"""Highest SH degree of the extension."""
MAGIC = b"glTF"
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
    """The primitives of a .glb."""

    params: dict[str, Tensor]
    """A field by the names of ``gaussians.parameters.SPLAT_NAMES``, float32 on the CPU."""
    antialiased: bool
    """Whether we marked it as trained with antialiasing."""
    in_model_frame: bool
    """Whether coordinates are those of nerfstudio's model."""


def semantics(degree: int) -> list[str]:
    """Names of the attributes of SH coefficients of degrees 1 to ``degree``, in the order of ``features_rest``."""
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(1, degree + 1) for n in range(2 * d + 1)]


def write_glb(
    path: Path, params: Mapping[str, Tensor], *, antialiased: bool = False, in_model_frame: bool = False
) -> None:
    """Write the base colours of a field as a .glb, atomically.

    Args:
        path: the file; its folder must exist.
        params: a finite field of SH degree at most 3; see :mod:`sundae_ns.gaussians.parameters`. ``features`` are not
            written.
        antialiased: mark the scene as trained with antialiasing, for :func:`read_glb`.
        in_model_frame: the field is in the coordinates of nerfstudio's model.

    Raises:
        DataError: the field has no primitives, an SH degree above 3, or wrong shapes.
        StorageError: the disk is full or not writable.
    """
    check_field(params)
    if not len(params["means"]):
        raise DataError(f"{path} would have no primitives; keep at least one")
    if sh_degree(params["features_rest"]) > MAX_SH_DEGREE:
        raise DataError(f"a .glb stores SH degrees up to {MAX_SH_DEGREE}; cut the coefficients, or write a .ply")
    field = {name: value.detach().float().cpu() for name, value in params.items()}
    field = similarity(field, _FROM_MODEL if in_model_frame else _FROM_PLY, 1.0)
    opacities = field["opacities"].sigmoid()
    quats = torch.nn.functional.normalize(field["quats"], dim=1)
    quats[quats.norm(dim=1) < 0.5] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    shown = torch.cat([SH_C0 * field["features_dc"] + 0.5, opacities], dim=1).clamp(0, 1)
    attributes = {
        "POSITION": field["means"],
        "COLOR_0": (255 * shown).round().to(torch.uint8),
        f"{EXTENSION}:ROTATION": quats.roll(-1, dims=1),
        f"{EXTENSION}:SCALE": field["scales"].exp(),
        f"{EXTENSION}:OPACITY": opacities,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": field["features_dc"],
    }
    rest = field["features_rest"].unbind(dim=1)
    attributes |= dict(zip(semantics(sh_degree(field["features_rest"])), rest, strict=True))
    stated = {_MODEL_FRAME: in_model_frame, _ANTIALIASED: antialiased}
    document, binary = _document(attributes, {name: True for name, true in stated.items() if true})
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(_HEADER.pack(MAGIC, 2, _HEADER.size + 2 * _CHUNK.size + len(document) + len(binary)))
        file.write(_CHUNK.pack(len(document), _JSON) + document)
        file.write(_CHUNK.pack(len(binary), _BINARY))
        file.write(binary)


def _document(attributes: Mapping[str, Tensor], stated: Mapping[str, bool]) -> tuple[bytes, bytes]:
    """The JSON and the binary part of a file with one primitive of these attributes."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, int]] = []
    parts, offset = [], 0
    kinds = {number: kind for kind, number in _NUMBERS.items()}
    for name, value in attributes.items():
        data = value.contiguous().numpy().tobytes()
        accessor = {"bufferView": len(views), "count": len(value), "type": kinds[value.shape[1]]}
        accessor |= {"componentType": _FLOAT} if value.is_floating_point() else {}
        accessor |= {} if value.is_floating_point() else {"componentType": _UNSIGNED_BYTE, "normalized": True}
        if name == "POSITION":  # as glTF demands
            accessor |= {"min": value.amin(dim=0).tolist(), "max": value.amax(dim=0).tolist()}
        accessors.append(accessor)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(data), "target": _VERTICES})
        parts.append(data)
        offset += len(data)
    splats = {
        **{"kernel": "ellipse", "colorSpace": "srgb_rec709_display"},
        **{"projection": "perspective", "sortingMethod": "cameraDistance"},
    }
    primitive = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: splats},
    }
    document = {
        "asset": {"version": "2.0", "generator": "sundae_ns", **({"extras": {_OURS: stated}} if stated else {})},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    return text + b" " * (-len(text) % 4), b"".join(parts)  # every part is a multiple of four bytes


def read_glb(path: Path) -> GltfScene:
    """Read the Gaussians of a .glb of any program; meshes and cameras beside them are left out. No code in it runs.

    Raises:
        DataError: the file is missing, damaged, no .glb, or holds no Gaussians in a form that this module reads.
    """
    with reading(path, "a complete .glb with Gaussians", mend="export it again, or as .ply"):
        document, binary = _chunks(path)
        try:
            return _scene_of(document, binary)
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            raise ValueError("its JSON is not that of a glTF scene") from error


def _scene_of(document: Mapping[str, Any], binary: memoryview) -> GltfScene:
    found = [_read_primitive(document, binary, *place) for place in _placed(document)]
    if not found:
        raise ValueError(f"no mesh of its scene has {EXTENSION}")
    if len({part["features_rest"].shape[1] for part in found}) > 1:
        raise ValueError("its Gaussians have different SH degrees")
    params = {name: torch.cat([part[name] for part in found]) for name in found[0]}
    stated = document["asset"].get("extras", {}).get(_OURS, {})
    in_model_frame = stated.get(_MODEL_FRAME) is True
    params = similarity(params, _FROM_MODEL if in_model_frame else _FROM_PLY, 1.0)
    return GltfScene(params, stated.get(_ANTIALIASED) is True, in_model_frame)


def _chunks(path: Path) -> tuple[dict[str, Any], memoryview]:
    """The document, and the bytes of the first buffer."""
    size = regular(path).stat().st_size
    with path.open("rb") as file:
        magic, version, length = _HEADER.unpack(file.read(_HEADER.size))
        if magic != MAGIC or version != 2 or length > size:
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
    """Primitives of the scene with Gaussians, and where the nodes above them put them ``[4, 4]``."""
    nodes = document.get("nodes", [])
    scene = document["scenes"][document.get("scene", 0)]
    open_nodes = [(index, np.eye(4)) for index in scene.get("nodes", [])]
    for _ in range(_MOST_NODES):
        if not open_nodes:
            return
        index, above = open_nodes.pop()
        node = nodes[_index(index)]
        place = above @ _matrix(node)
        open_nodes += [(child, place) for child in node.get("children", [])]
        if "mesh" in node:
            for primitive in document["meshes"][_index(node["mesh"])]["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    yield primitive, place
    raise ValueError(f"its scene has more than {_MOST_NODES:,} nodes, or a node below itself")


def _index(value: object) -> int:
    """An index of the document."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{value!r} is no index")
    return value


def _matrix(node: Mapping[str, Any]) -> NDArray[np.float64]:
    """A node's transform."""
    if "matrix" in node:
        return _numbers(node["matrix"], 16).reshape(4, 4).T
    x, y, z, w = _numbers(node.get("rotation", (0, 0, 0, 1)), 4)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    found = np.eye(4)
    found[:3, :3] = turn * _numbers(node.get("scale", (1, 1, 1)), 3)
    found[:3, 3] = _numbers(node.get("translation", (0, 0, 0)), 3)
    return found


def _numbers(values: Any, count: int) -> NDArray[np.float64]:
    """Some numbers of the document."""
    if len(values) != count or any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
        raise TypeError(f"{values!r} are not {count} numbers")
    return np.array(values, dtype=np.float64)


def _read_primitive(
    document: Mapping[str, Any], binary: memoryview, primitive: Mapping[str, Any], place: NDArray[np.float64]
) -> dict[str, Tensor]:
    """The field of one primitive of the document, where its nodes put it."""
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
    check_field(params)
    return _moved(params, place)


def _moved(params: dict[str, Tensor], place: NDArray[np.float64]) -> dict[str, Tensor]:
    """A field where a transform of nodes puts it."""
    if np.array_equal(place, np.eye(4)):
        return params
    linear = place[:3, :3]
    factor = np.cbrt(np.linalg.det(linear))
    if not (math.isfinite(factor) and factor > 0) or not np.allclose(
        linear @ linear.T, factor**2 * np.eye(3), rtol=1e-4
    ):
        raise ValueError("a node mirrors or stretches its Gaussians")
    moved = np.concatenate([linear / factor, place[:3, 3:] / factor], axis=1)
    return similarity(params, torch.from_numpy(moved).float(), float(factor))


def _values(document: Mapping[str, Any], binary: memoryview, index: object) -> NDArray[np.float32]:
    """Values of an accessor ``[N, C]``; integers are normalised if it says so."""
    accessor = document["accessors"][_index(index)]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise ValueError("it has sparse or empty accessors")
    view = document["bufferViews"][_index(accessor["bufferView"])]
    if _index(view.get("buffer", 0)) != 0 or "uri" in document["buffers"][0] or view.get("extensions"):
        raise ValueError("its data are compressed, or in another file")
    kind, columns = np.dtype(_COMPONENTS[accessor["componentType"]]), _NUMBERS[accessor["type"]]
    rows, start = _index(accessor["count"]), _index(view.get("byteOffset", 0))
    stride = _index(view.get("byteStride", kind.itemsize * columns))
    inside = _index(accessor.get("byteOffset", 0))
    used = inside + (rows - 1) * stride + kind.itemsize * columns if rows else 0
    if (
        used > _index(view["byteLength"])
        or start + view["byteLength"] > len(binary)
        or stride < kind.itemsize * columns
    ):
        raise ValueError("its accessors reach beyond its data")
    table: NDArray[Any] = np.ndarray((rows, columns), kind, binary, start + inside, (stride, kind.itemsize))
    found = table.astype(np.float32)
    if accessor.get("normalized") is True and kind.kind in "iu":
        found = np.maximum(found / np.float32(np.iinfo(kind).max), -1)
    return found
