"""The .ply of 3D Gaussian splatting, which viewers and converters read, and the .ply of points.

One binary vertex per primitive, all properties float32, values before activation as in
:mod:`sundae_ns.gaussians.parameters`: ``x y z  nx ny nz  f_dc_0..2  f_rest_*  opacity  scale_0..2  rot_0..3``. Normals
are zero. ``f_rest`` is channel-major: all coefficients of red, then green, then blue. The format stores base colours
only: no feature vectors and no head. Read are also colours in place of SH coefficients (``ns-export`` writes them), and
the compressed .ply of PlayCanvas.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from io import BufferedReader, FileIO
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from torch import Tensor

from sundae_ns.errors import DataError, SundaeError, reading, regular
from sundae_ns.gaussians.parameters import SPLAT_NAMES, num_primitives, odd_shapes, rgb_to_sh, sh_degree_of
from sundae_ns.storage.atomic import replacing
from sundae_ns.storage.compressed_ply import PACKED, decompressed
from sundae_ns.storage.point_cloud import points_of

MODEL_FRAME = "Coordinates: nerfstudio model"
"""Header comment of files in the coordinates of nerfstudio's model, not of the capture."""
_COLUMNS = {
    "means": ("x", "y", "z"),
    "features_dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacities": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_NORMALS = ("nx", "ny", "nz")
_RGB = ("red", "green", "blue")
_SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
_SIZES |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4, "float64": 8}
_MAX_HEADER = 1 << 16  # bytes


def _rest_columns(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


def check_field(params: Mapping[str, Tensor], failure: type[SundaeError] = DataError) -> None:
    """Raise a ``failure`` unless a field has all of ``SPLAT_NAMES``, in their shapes."""
    missing = [name for name in SPLAT_NAMES if name not in params]
    if missing:
        raise failure(f"the field has no {', '.join(missing)}; it needs all of {', '.join(SPLAT_NAMES)}")
    for odd in odd_shapes(params):
        raise failure(odd)


def write_ply(path: Path, params: Mapping[str, Tensor], *, comments: Sequence[str] = ()) -> None:
    """Write the base colours of a field as a 3DGS .ply, atomically.

    Args:
        path: the file; its folder must exist.
        params: a field; see :mod:`sundae_ns.gaussians.parameters`. ``features`` are not written. Values that are not
            finite are written unchanged: drop such primitives first (``finite_mask``), because viewers do not.
        comments: lines for the header: :data:`MODEL_FRAME` for the field of a nerfstudio model, ``SplatRenderMode:
            mip`` for an antialiased scene.

    Raises:
        DataError: a parameter is missing or has the wrong shape.
        StorageError: the disk is full or not writable.
    """
    check_field(params)
    n = num_primitives(params)
    means, *others = _table(params)
    blocks = [means, (_NORMALS, np.zeros((n, 3), np.float32)), *others]
    names = [name for block, _ in blocks for name in block]
    table = np.ascontiguousarray(np.concatenate([values for _, values in blocks], axis=1), dtype="<f4")
    vertices = table.view([(name, "<f4") for name in names]).reshape(n)
    data = PlyData([PlyElement.describe(vertices, "vertex")], text=False, byte_order="<", comments=list(comments))
    with replacing(path) as partial:
        data.write(str(partial))


def _table(params: Mapping[str, Tensor]) -> list[tuple[tuple[str, ...], NDArray[np.float32]]]:
    """Properties of a field and their values ``[N, C]``, in the order of the format."""
    values = {name: params[name].detach().to("cpu", torch.float32).numpy() for name in SPLAT_NAMES}
    rest = (
        values["features_rest"].transpose(0, 2, 1).reshape(num_primitives(params), 3 * params["features_rest"].shape[1])
    )
    blocks = [(_COLUMNS[name], values[name]) for name in ("means", "features_dc", "opacities", "scales", "quats")]
    return [*blocks[:2], (_rest_columns(rest.shape[1]), rest), *blocks[2:]]


def _header(path: Path) -> bytes:
    """The header of a .ply with the end of its last line; nothing if it has none. ``OSError`` if it cannot be read."""
    with regular(path).open("rb") as file:
        begin = file.read(_MAX_HEADER)
    newline = b"\r\n" if begin[3:5] == b"\r\n" else begin[3:4]
    # A comment may contain the word.
    content, end, _ = begin.partition(newline + b"end_header" + newline)
    return content + end if end and newline in (b"\n", b"\r", b"\r\n") else b""


def _check_header(path: Path, primitives: bool) -> None:
    """Check the header alone: plyfile allocates by it, and reads lists and text row by row, in minutes."""
    header = _header(path)
    lines = [line.split() for line in header.splitlines()]
    if lines[:1] != [[b"ply"]]:
        raise _incomplete(path, "it has no .ply header")
    text = [b"format", b"ascii", b"1.0"] in lines
    # In ascii, each value takes at least a digit and a space.
    elements: list[tuple[int, int]] = []
    lists: dict[str, str] = {}
    name = ""
    for words in lines:
        if words[:1] == [b"element"] and len(words) == 3 and words[2].isdigit():
            elements.append((int(words[2]), 0))
            name = words[1].decode("latin-1")
        elif words[:1] == [b"property"] and elements and len(words) >= 3:
            is_list = words[1] == b"list"
            kind = words[2] if is_list else words[1]
            count, size = elements[-1]
            elements[-1] = (count, size + (2 if text else _SIZES.get(kind.decode("latin-1"), 1)))
            if is_list:
                lists.setdefault(name, words[-1].decode("latin-1"))
    if any(count > 0 and size == 0 for count, size in elements):
        raise _incomplete(path, "an element has no properties")
    stated, available = sum(count * size for count, size in elements), path.stat().st_size - len(header)
    if stated > available:
        raise _incomplete(path, f"its header states at least {stated:,} bytes, it has {available:,}")
    if primitives and text:
        raise DataError(f"{path} is an ascii .ply; export it as binary.")
    for element, listed in lists.items():
        if primitives or element == "vertex":
            raise DataError(
                f"property {listed} of each {element} in {path} is a list, not a number; export the .ply again."
            )


def _incomplete(path: Path, reason: str) -> DataError:
    return DataError(f"{path} is not a complete .ply file ({reason}); export it again.")


def _load(path: Path, *, primitives: bool = False) -> PlyData:
    """Parse any .ply with vertices, allocating no more than a few times its size.

    ``primitives`` refuses what no binary .ply of Gaussian primitives has: text and lists.
    """
    with reading(path, "a complete .ply file"):
        _check_header(path, primitives)
        with _AsciiHeader(FileIO(path), len(_header(path))) as file:
            data = PlyData.read(file)
    if "vertex" not in data:
        raise DataError(f"{path} has no vertices; give a .ply of points or of Gaussian primitives.")
    return data


class _AsciiHeader(BufferedReader):
    """A .ply whose header plyfile can decode: a comment in UTF-8 reads as question marks.

    A file, because plyfile maps it; from other streams it reads single vertices (90 s per million instead of 1 s).
    """

    def __init__(self, raw: FileIO, header_size: int) -> None:
        super().__init__(raw)
        self._left = header_size

    def read(self, size: int | None = -1, /) -> bytes:
        """As of any file; plyfile reads the header byte by byte."""
        found = super().read(size)
        if self._left > 0 and found:
            self._left -= len(found)
            found = found if found.isascii() else b"?" * len(found)
        return found


def _stacked(vertex: PlyElement, columns: Sequence[str]) -> Tensor:
    """Properties of all vertices as columns: ``[N, len(columns)]`` float32."""
    table = np.empty((vertex.count, len(columns)), np.float32)
    for i, name in enumerate(columns):
        with np.errstate(over="ignore"):  # values beyond float32 become infinite; callers drop them
            table[:, i] = vertex[name]
    return torch.from_numpy(table)


def read_ply(path: Path) -> dict[str, Tensor]:
    """Read a binary 3DGS .ply, with SH coefficients or with colours, or a compressed one; ignores other properties.

    Returns:
        A field by the names of :data:`sundae_ns.gaussians.parameters.SPLAT_NAMES`, float32 on the CPU. The SH degree
        follows from the number of ``f_rest_*``; without any, ``features_rest`` is ``[N, 0, 3]``. Values may be
        infinite, where that is how the file states an opacity of 1; see ``gaussians.mend``.

    Raises:
        DataError: the file is missing, not a binary .ply, truncated, or does not hold Gaussian primitives.
    """
    data = _load(path, primitives=True)
    vertex = data["vertex"]
    present = {prop.name for prop in vertex.properties}
    if present.issuperset(PACKED):
        with reading(path, "a complete compressed .ply"):
            return decompressed(data["chunk"].data, vertex.data, data["sh"].data if "sh" in data else None)
    columns = dict(_COLUMNS)
    if present.issuperset(_RGB) and not present & set(_COLUMNS["features_dc"]):
        columns["features_dc"] = _RGB
    missing = [name for names in columns.values() for name in names if name not in present]
    if missing:
        raise DataError(f"{path} lacks {', '.join(missing)}; give a .ply of 3D Gaussian primitives with SH colours.")
    rest = sum(name.startswith("f_rest_") for name in present)
    degree = sh_degree_of(rest // 3) if rest % 3 == 0 else None
    if degree is None or not present.issuperset(_rest_columns(rest)):
        raise DataError(f"{path} has {rest} f_rest properties, which fit no SH degree; export it again.")

    params = {name: _stacked(vertex, names) for name, names in columns.items()}
    if columns["features_dc"] == _RGB:
        kind = vertex["red"].dtype
        # Bytes, 16-bit numbers, or floats to 1, which some programs write to 255.
        most = float(np.iinfo(kind).max) if kind.kind in "iu" else 255.0 if (params["features_dc"] > 2).any() else 1.0
        params["features_dc"] = rgb_to_sh(params["features_dc"] / most)
    # The file has all coefficients of red, then green, then blue.
    order = [f"f_rest_{channel * (rest // 3) + i}" for i in range(rest // 3) for channel in range(3)]
    params["features_rest"] = _stacked(vertex, order).reshape(vertex.count, rest // 3, 3)
    return {name: params[name] for name in SPLAT_NAMES}


def read_point_cloud(path: Path, *, precise: bool = False) -> tuple[Tensor, Tensor]:
    """Read the points and colours of a .ply, binary or ascii.

    Args:
        path: vertices with ``x y z`` and, optionally, colours under a name in use: ``red green blue``, ``r g b``,
            ``diffuse_red ...``, or ``f_dc_0 ...`` of a field. Integers of 8 or 16 bits, floats to 1, 255 or 65,535.
        precise: positions as float64, for coordinates far from the origin.

    Returns:
        Positions ``[N, 3]`` float32 and colours ``[N, 3]`` uint8, on the CPU; points without a colour are mid-grey.

    Raises:
        DataError: the file is missing, not a .ply, truncated, or its vertices have no position.
    """
    points = points_of(_load(path)["vertex"], precise)
    if points is None:
        raise DataError(f"{path} has vertices without x, y and z; give a .ply of points.")
    return points


def keep_vertices(source: Path, out: Path, mask: Tensor, params: Mapping[str, Tensor] | None = None) -> None:
    """Copy a .ply with only some of its vertices; properties, comments and other elements are unchanged.

    Args:
        source: a .ply that has its values as :func:`has_own_columns` says.
        out: the file to write atomically.
        mask: True for vertices to keep, bool ``[N]``.
        params: new parameters of the kept primitives ``[M, ...]``; None to keep their values.

    Raises:
        DataError: the file cannot be read, or has another number of vertices.
        StorageError: the disk is full or not writable.
    """
    data = _load(source, primitives=True)
    vertex = data["vertex"]
    if vertex.count != len(mask):
        raise DataError(f"{source} has {vertex.count} vertices, not {len(mask)}: it was changed meanwhile; run again.")
    rows = np.asarray(vertex.data[mask.cpu().numpy()])
    for names, values in _table(params) if params is not None else ():
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    # The header's own bytes, because plyfile writes no comment in UTF-8.
    header = re.sub(rb"(?<=[\r\n])(element\s+vertex\s+)\d+", rb"\g<1>%d" % len(rows), _header(source), count=1)
    with replacing(out) as partial, partial.open("wb") as file:
        file.write(header)
        for element in data.elements:
            values = rows if element.name == "vertex" else np.ascontiguousarray(element.data)
            file.write(values.view(np.uint8).data if len(values) else b"")  # tofile hides why it fails


def has_own_columns(path: Path) -> bool:
    """Whether a .ply that :func:`read_ply` reads has the values of a field as they are, so that rows can be copied."""
    names = {prop.name for prop in _load(path, primitives=True)["vertex"].properties}
    return all(names.issuperset(columns) for columns in _COLUMNS.values())


def ply_comments(path: Path) -> list[str]:
    """Comments in the header of a .ply; an empty list for any other file or an unreadable one."""
    try:
        header = _header(path)
    except OSError:
        return []
    mark = b"comment "
    comments = [line[len(mark) :].strip() for line in header.splitlines() if line.startswith(mark)]
    return [comment.decode("utf-8", "replace") for comment in comments] if header.startswith(b"ply") else []


def is_nerfstudio_ply(path: Path) -> bool:
    """Whether a .ply is in the coordinates of nerfstudio's model, by its header; False for unreadable files.

    True for files of ``ns-export gaussian-splat`` and files with :data:`MODEL_FRAME`. Files of other programs are in
    the coordinates of the capture.
    """
    # nerfstudio 1.1.5 writes the misspelt first one.
    marks = ("Generated by Nerstudio", "Generated by Nerfstudio", MODEL_FRAME)
    return any(comment.startswith(marks) for comment in ply_comments(path))
