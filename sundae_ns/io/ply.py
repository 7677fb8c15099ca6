"""The .ply of 3D Gaussian splatting, the compressed .ply of PlayCanvas, and the .ply of points.

3DGS: one binary vertex per Gaussian, all properties float32, values before activation:

    x y z  nx ny nz  f_dc_0..2  f_rest_0..3K-1  opacity  scale_0..2  rot_0..3 (wxyz)

Normals are zero. ``f_rest`` is channel-major: K coefficients of red, then green, then blue. Feature vectors and heads
do not fit. Readers also take ``red green blue`` in place of SH coefficients (``ns-export`` writes them).

Compressed (SuperSplat, splat-transform), all words from the top bit down:

    element chunk   min and max of x y z, scale_x.., and (not in old files) r g b; one for each 256 vertices
    element vertex  packed_position 11 10 11, packed_rotation 2 10 10 10, packed_scale 11 10 11, packed_color 8 8 8 8
    element sh      f_rest_* as bytes in [-4, 4]; may be missing

Positions, log-scales and colours lie between the bounds of their chunk. A rotation is the index of its largest
component, then the other three.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from torch import Tensor

from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.core.files import replacing
from sundae_ns.core.gaussians import SPLAT_NAMES, odd_shapes, rgb_to_sh, sh_degree_of, sh_to_rgb

MODEL_FRAME = "Coordinates: nerfstudio model"
"""Header comment of files in the coordinates of nerfstudio's model, not of the capture."""
LEAST_OPACITY = 1e-6
"""Opacity of a byte of 0, and what one of 255 lacks to 1, in formats of bytes: their logits stay finite."""
MAX_SH_DEGREE = 3  # of .spz, .sog and .glb
_COLUMNS = {
    "means": ("x", "y", "z"),
    "features_dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacities": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_RGB = ("red", "green", "blue")
_CLOUD_COLORS: tuple[tuple[str, ...], ...] = (
    _RGB,
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    ("scalar_red", "scalar_green", "scalar_blue"),
    _COLUMNS["features_dc"],
)
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_CHUNK = 256
_SIZES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
_SIZES |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4, "float64": 8}


def check_gaussians(params: Mapping[str, Tensor], failure: type[Exception] = DataError) -> None:
    """Raise a ``failure`` unless there are all of ``SPLAT_NAMES``, in their shapes."""
    if missing := [name for name in SPLAT_NAMES if name not in params]:
        raise failure(f"the scene has no {', '.join(missing)}; it needs all of {', '.join(SPLAT_NAMES)}")
    for odd in odd_shapes(params):
        raise failure(odd)


def checked(path: Path, params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The parameters that .spz, .sog and .glb store, float32 on the CPU; quaternions become unit ones.

    Raises:
        DataError: there are no Gaussians, values that are not finite, an SH degree above 3, or wrong shapes.
    """
    check_gaussians(params)
    gaussians = {name: params[name].detach().to("cpu", torch.float32).contiguous() for name in SPLAT_NAMES}
    if not len(gaussians["means"]):
        raise DataError(f"the scene has no Gaussians, which a {path.suffix} cannot store; check the run")
    if not all(bool(value.isfinite().all()) for value in gaussians.values()):
        raise DataError("some values are NaN or infinite; drop those Gaussians first (finite_mask)")
    if gaussians["features_rest"].shape[1] > (MAX_SH_DEGREE + 1) ** 2 - 1:
        raise DataError(f"a {path.suffix} stores SH degrees up to {MAX_SH_DEGREE}; cut features_rest, or write a .ply")
    # Opacities beyond these logits are 0 and 1 in every format, and would overflow before they are.
    gaussians["opacities"] = gaussians["opacities"].clamp(-30.0, 30.0)
    # Normalise in float64: the square of 1e-30 is 0 in float32.
    quats = gaussians["quats"].double()
    quats[(quats == 0).all(dim=1), 0] = 1.0
    gaussians["quats"] = (quats / quats.norm(dim=1, keepdim=True)).float()
    return gaussians


def _table(params: Mapping[str, Tensor]) -> tuple[list[str], NDArray[np.float32]]:
    """Properties of Gaussians but the normals, and their values ``[N, C]``, in the order of the format."""
    values = {name: params[name].detach().to("cpu", torch.float32).numpy() for name in SPLAT_NAMES}
    n, width = len(values["means"]), 3 * values["features_rest"].shape[1]
    values["features_rest"] = values["features_rest"].transpose(0, 2, 1).reshape(n, width)
    columns = {**_COLUMNS, "features_rest": tuple(f"f_rest_{i}" for i in range(width))}
    order = ("means", "features_dc", "features_rest", "opacities", "scales", "quats")
    names = [column for name in order for column in columns[name]]
    return names, np.concatenate([values[name] for name in order], axis=1)


def write_ply(path: Path, params: Mapping[str, Tensor], *, comments: Sequence[str] = ()) -> None:
    """Write the base colours of Gaussians as a 3DGS .ply, atomically.

    Args:
        path: the file; its folder must exist.
        params: see :mod:`sundae_ns.core.gaussians`. ``features`` are not written. Values that are not finite are
            written unchanged: drop such Gaussians first (``finite_mask``), because viewers do not.
        comments: lines for the header: :data:`MODEL_FRAME` for Gaussians of a nerfstudio model, ``SplatRenderMode:
            mip`` for an antialiased scene.

    Raises:
        DataError: a parameter is missing or has the wrong shape.
        StorageError: the disk is full or not writable.
    """
    check_gaussians(params)
    names, table = _table(params)
    names[3:3] = ("nx", "ny", "nz")
    table = np.insert(table, [3, 3, 3], 0, axis=1).astype("<f4", copy=False)
    vertices = table.view([(name, "<f4") for name in names]).reshape(len(table))
    data = PlyData([PlyElement.describe(vertices, "vertex")], text=False, byte_order="<", comments=list(comments))
    with replacing(path) as partial:
        data.write(str(partial))


def keep_vertices(source: Path, out: Path, mask: Tensor, params: Mapping[str, Tensor] | None = None) -> None:
    """Copy a .ply with only some of its vertices, atomically; properties, comments and other elements are unchanged.

    The ``source`` has its values as :func:`has_own_columns` says. ``mask`` is True for vertices to keep, bool ``[N]``;
    ``params`` are new parameters of these ``[M, ...]``, None to keep their values.

    Raises:
        DataError: the file cannot be read, or has another number of vertices.
        StorageError: the disk is full or not writable.
    """
    data = _load(source, primitives=True)
    vertex = data["vertex"]
    if vertex.count != len(mask):
        raise DataError(f"{source} has {vertex.count} vertices, not {len(mask)}: it was changed meanwhile; run again.")
    rows = np.asarray(vertex.data[mask.cpu().numpy()])
    if params is not None:
        names, table = _table(params)
        for name, column in zip(names, table.T, strict=True):
            rows[name] = column
    # The header's own bytes, because plyfile writes no comment in UTF-8.
    header = re.sub(rb"(?<=[\r\n])(element\s+vertex\s+)\d+", rb"\g<1>%d" % len(rows), _header(source), count=1)
    with replacing(out) as partial, partial.open("wb") as file:
        file.write(header)
        for element in data.elements:
            values = rows if element.name == "vertex" else np.ascontiguousarray(element.data)
            file.write(values.view(np.uint8).data if len(values) else b"")  # tofile hides why it fails


def _header(path: Path) -> bytes:
    """The header of a .ply with the end of its last line; empty if it has none. ``OSError`` if it cannot be read."""
    with regular(path).open("rb") as file:
        begin = file.read(1 << 16)
    newline = b"\r\n" if begin[3:5] == b"\r\n" else begin[3:4]
    # A comment may contain the word.
    content, end, _ = begin.partition(newline + b"end_header" + newline)
    return content + end if end and newline in (b"\n", b"\r", b"\r\n") else b""


def _check_header(path: Path, primitives: bool) -> bytes:
    """Check the header alone, and return it: plyfile allocates by it, and reads lists and text row by row, in minutes.

    ``primitives`` refuses text and lists, which no .ply of Gaussians has.
    """
    header = _header(path)
    lines = [line.split() for line in header.decode("latin-1").splitlines()]
    text = ["format", "ascii", "1.0"] in lines
    counts: list[int] = []
    sizes: list[int] = []  # least bytes of a row; in ascii, a value takes at least a digit and a space
    lists: list[tuple[str, str]] = []
    element = ""
    for words in lines:
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            element = words[1]
            counts.append(int(words[2]))
            sizes.append(0)
        elif words[:1] == ["property"] and counts and len(words) >= 3:
            is_list = words[1] == "list"
            sizes[-1] += 2 if text else _SIZES.get(words[2] if is_list else words[1], 1)
            lists += [(element, words[-1])] if is_list else []
    least = sum(count * size for count, size in zip(counts, sizes, strict=True))
    available = path.stat().st_size - len(header)
    if lines[:1] != [["ply"]]:
        raise ValueError("it has no .ply header")
    if any(count > 0 and size == 0 for count, size in zip(counts, sizes, strict=True)):
        raise ValueError("an element has no properties")
    if least > available:
        raise ValueError(f"its header states at least {least:,} bytes, it has {available:,}")
    if primitives and text:
        raise DataError(f"{path} is an ascii .ply; export it as binary.")
    for element, name in lists:
        if primitives or element == "vertex":
            raise DataError(f"property {name} of each {element} in {path} is a list, not a number; export it again.")
    return header


def _load(path: Path, *, primitives: bool = False) -> PlyData:
    """Parse any .ply with vertices, allocating no more than a few times its size."""
    with reading(path, "a complete .ply file"):
        header = _check_header(path, primitives)
        with _AsciiHeader(FileIO(path), len(header)) as file:
            data = PlyData.read(file)
    if "vertex" not in data:
        raise DataError(f"{path} has no vertices; give a .ply of points or of Gaussians.")
    return data


class _AsciiHeader(BufferedReader):
    """A .ply whose header plyfile can decode: a comment in UTF-8 reads as question marks.

    A file, because plyfile maps it; from other streams it reads single vertices: 90 s per million, not 1 s.
    """

    def __init__(self, raw: FileIO, header_size: int) -> None:
        super().__init__(raw)
        self._left = header_size

    def read(self, size: int | None = -1, /) -> bytes:
        """As of any file; plyfile reads the header byte by byte."""
        content = super().read(size)
        if self._left > 0 and content:
            self._left -= len(content)
            content = content if content.isascii() else b"?" * len(content)
        return content


def has_own_columns(path: Path) -> bool:
    """Whether a .ply that :func:`read_ply` reads has unpacked values, so that rows can be copied."""
    names = {prop.name for prop in _load(path, primitives=True)["vertex"].properties}
    return all(names.issuperset(columns) for columns in _COLUMNS.values())


def ply_comments(path: Path) -> list[str]:
    """Comments in the header of a .ply; an empty list for any other file or an unreadable one."""
    try:
        header = _header(path)
    except OSError:
        return []
    lines = header.splitlines() if header.startswith(b"ply") else []
    comments = [line.removeprefix(b"comment ").strip() for line in lines if line.startswith(b"comment ")]
    return [comment.decode("utf-8", "replace") for comment in comments]


def is_nerfstudio_ply(path: Path) -> bool:
    """Whether a .ply is in the coordinates of nerfstudio's model, by its header; False for unreadable files.

    True for files of ``ns-export gaussian-splat`` and files with :data:`MODEL_FRAME`. Files of other programs are in
    the coordinates of the capture.
    """
    # nerfstudio 1.1.5 writes the misspelt first one.
    marks = ("Generated by Nerstudio", "Generated by Nerfstudio", MODEL_FRAME)
    return any(comment.startswith(marks) for comment in ply_comments(path))


def _columns(rows: Any, names: Sequence[str], dtype: type[np.floating[Any]] = np.float32) -> Tensor:
    """Properties of vertices as columns ``[N, len(names)]``."""
    table = np.empty((len(rows), len(names)), dtype)
    for i, name in enumerate(names):
        with np.errstate(over="ignore"):  # values beyond float32 become infinite; callers drop them
            table[:, i] = rows[name]
    return torch.from_numpy(table)


def read_ply(path: Path) -> dict[str, Tensor]:
    """Read a binary 3DGS .ply, with SH coefficients or with colours, or a compressed one; ignores other properties.

    Returns:
        Gaussians by the names of :data:`sundae_ns.core.gaussians.SPLAT_NAMES`, float32 on the CPU. The SH degree
        follows from the number of ``f_rest_*``; without any, ``features_rest`` is ``[N, 0, 3]``. Values may be
        infinite, such as the logit of an opacity of 1; see ``gaussians.sanitise``.

    Raises:
        DataError: the file is missing, not a binary .ply, truncated, or does not hold Gaussians.
    """
    data = _load(path, primitives=True)
    rows = data["vertex"].data
    present = set(rows.dtype.names or ())
    if present.issuperset(_PACKED):
        with reading(path, "a complete compressed .ply"):
            return _decompressed(data["chunk"].data, rows, data["sh"].data if "sh" in data else None)
    columns = dict(_COLUMNS)
    if present.issuperset(_RGB) and not present & set(_COLUMNS["features_dc"]):
        columns["features_dc"] = _RGB
    missing = [name for names in columns.values() for name in names if name not in present]
    if missing:
        raise DataError(f"{path} lacks {', '.join(missing)}; give a .ply of 3D Gaussians with SH colours.")
    rest = sum(name.startswith("f_rest_") for name in present)
    degree = sh_degree_of(rest // 3) if rest % 3 == 0 else None
    if degree is None or not present.issuperset(f"f_rest_{i}" for i in range(rest)):
        raise DataError(f"{path} has {rest} f_rest properties, which fit no SH degree; export it again.")

    params = {name: _columns(rows, names) for name, names in columns.items()}
    if columns["features_dc"] == _RGB:
        kind = rows["red"].dtype
        # Bytes, 16-bit numbers, or floats to 1, which some programs write to 255.
        most = float(np.iinfo(kind).max) if kind.kind in "iu" else 255.0 if (params["features_dc"] > 2).any() else 1.0
        params["features_dc"] = rgb_to_sh(params["features_dc"] / most)
    # The file has all coefficients of red, then green, then blue.
    order = [f"f_rest_{channel * (rest // 3) + i}" for i in range(rest // 3) for channel in range(3)]
    params["features_rest"] = _columns(rows, order).reshape(len(rows), rest // 3, 3)
    return {name: params[name] for name in SPLAT_NAMES}


def _decompressed(chunks: NDArray[Any], vertices: NDArray[Any], harmonics: NDArray[Any] | None) -> dict[str, Tensor]:
    """Gaussians of the elements of a compressed .ply; ``ValueError`` if they do not fit together."""
    n = len(vertices)
    if len(chunks) < -(-n // _CHUNK):
        raise ValueError(f"{len(chunks)} chunks are too few for {n:,} Gaussians")
    chunk = np.arange(n) // _CHUNK

    def between(ratios: NDArray[np.float32], kind: str, axes: str) -> NDArray[np.float32]:
        bounds = ([f"{end}_{kind}{axis}" for axis in axes] for end in ("min", "max"))
        low, high = (_columns(chunks, names).numpy()[chunk] for names in bounds)
        return low + ratios * (high - low)

    color = _ratios(vertices["packed_color"], (8, 8, 8, 8))
    rgb = between(color[:, :3], "", "rgb") if "min_r" in (chunks.dtype.names or ()) else color[:, :3]
    rotation = (_ratios(vertices["packed_rotation"], (2, 10, 10, 10))[:, 1:] - 0.5) * np.float32(np.sqrt(2))
    values: dict[str, NDArray[Any]] = {
        "means": between(_ratios(vertices["packed_position"], (11, 10, 11)), "", "xyz"),
        "scales": between(_ratios(vertices["packed_scale"], (11, 10, 11)), "scale_", "xyz"),
        "quats": from_smallest_three(rotation, vertices["packed_rotation"].astype(np.uint32) >> np.uint32(30)),
        "features_rest": _decompressed_harmonics(harmonics, n),
    }
    gaussians = {name: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for name, value in values.items()}
    gaussians["features_dc"] = rgb_to_sh(torch.from_numpy(np.ascontiguousarray(rgb)))
    return {**gaussians, "opacities": torch.logit(torch.from_numpy(color[:, 3:].copy()), eps=LEAST_OPACITY)}


def _ratios(words: NDArray[Any], bits: tuple[int, ...]) -> NDArray[np.float32]:
    """Fields of 32-bit words, from the top bit down, relative to their largest value ``[N, len(bits)]``."""
    shifts = (32 - np.cumsum(bits)).astype(np.uint32)
    largest = ((1 << np.array(bits)) - 1).astype(np.uint32)
    levels = (words.astype(np.uint32)[:, None] >> shifts) & largest
    return levels.astype(np.float32) / largest.astype(np.float32)


def from_smallest_three(others: NDArray[Any], largest: NDArray[Any]) -> NDArray[Any]:
    """Unit quaternions ``[N, 4]`` of their three smaller components ``[N, 3]`` and the largest's index ``[N]``."""
    quats = np.empty((len(others), 4), others.dtype)
    quats[np.arange(4) != largest[:, None]] = others.ravel()
    quats[np.arange(len(others)), largest] = np.sqrt(np.clip(1 - (others**2).sum(axis=1), 0, None))
    return quats


def _decompressed_harmonics(rows: NDArray[Any] | None, n: int) -> NDArray[np.float32]:
    """SH coefficients ``[N, K, 3]``."""
    names = [] if rows is None else [name for name in rows.dtype.names or () if name.startswith("f_rest_")]
    if rows is None or not names:
        return np.zeros((n, 0, 3), np.float32)
    if len(rows) != n or len(names) % 3 or sh_degree_of(len(names) // 3) is None:
        raise ValueError(f"{len(names)} coefficients of {len(rows):,} Gaussians fit no SH degree")
    levels = np.stack([rows[f"f_rest_{i}"] for i in range(len(names))], axis=1)
    ratios = np.where(levels == 0, 0, np.where(levels == 255, 1, (levels + np.float32(0.5)) / 256))
    return (8 * (ratios - 0.5)).reshape(n, 3, -1).transpose(0, 2, 1).astype(np.float32)


def read_point_cloud(path: Path, *, precise: bool = False) -> tuple[Tensor, Tensor]:
    """Read the points and colours of a .ply, binary or ascii.

    Args:
        path: vertices with ``x y z`` and, optionally, colours under a name in use: ``red green blue``, ``r g b``,
            ``diffuse_red ...``, or ``f_dc_0 ...`` of Gaussians. Integers of 8 or 16 bits, floats to 1, 255 or 65,535.
        precise: positions as float64, for coordinates far from the origin.

    Returns:
        Positions ``[N, 3]`` float32 and colours ``[N, 3]`` uint8, on the CPU; points without a colour are mid-grey.

    Raises:
        DataError: the file is missing, not a .ply, truncated, or its vertices have no position.
    """
    rows = _load(path)["vertex"].data
    names = {name.lower(): name for name in rows.dtype.names or ()}
    if not names.keys() >= {"x", "y", "z"}:
        raise DataError(f"{path} has vertices without x, y and z; give a .ply of points.")
    points = _columns(rows, [names[axis] for axis in "xyz"], np.float64 if precise else np.float32)
    channels = next((channels for channels in _CLOUD_COLORS if names.keys() >= set(channels)), None)
    if channels is None:
        return points, torch.full((len(points), 3), 128, dtype=torch.uint8)
    colors = _columns(rows, [names[name] for name in channels])
    if channels == _COLUMNS["features_dc"]:
        colors = 255 * sh_to_rgb(colors)
    else:
        finite = colors[colors.isfinite()]
        largest = float(finite.max()) if len(finite) else 0.0
        is_float = rows[names[channels[0]]].dtype.kind == "f"
        # Floats have 1 for white, which some programs overshoot.
        white = 1.0 if is_float and largest <= 2 else 65535.0 if largest > 255 else 255.0
        colors *= 255 / white
    return points, colors.nan_to_num_(nan=0.0).round_().clamp_(0, 255).to(torch.uint8)
