"""The container of a packed scene: named arrays behind a JSON header, all bytes under checksums, none executable.

    offset   bytes
    0        8        magic 89 53 55 4E 44 41 45 0A
    8        4        version, u4 little-endian
    12       4        length H of the header, u4, at most 4 MiB
    16       32       SHA-256 of the header
    48       H        JSON in UTF-8; "sections" lists name, dtype, shape, parts and sha256 of each section, in order
    48 + H            the sections, each the concatenation of its parts

A section is one little-endian array. Each of its parts is a plane: one byte of every number of one row (of the first
dimension, if there are several). A plane is a raw deflate stream (RFC 1951), or is stored if that is not shorter.
All sections together unpack to at most ``SPARE`` bytes plus ``MAX_RATIO`` bytes per byte of the file, which readers
check before they allocate; a section ``padding`` makes that true where needed.

``format.json`` describes the header as JSON Schema, for this module and for ``web/src/scene/schema.ts``. It has three
keywords of its own: items of a list differ in the entry ``uniqueBy``; ``counts`` are whole numbers from 0 to a maximum;
an ``orthonormal`` list is a direction ``[3]`` or the rows of a pose ``[3, 4]``, of about unit length, at right angles,
and right-handed.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import sys
import zlib
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from importlib import resources
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sundae_ns.core.errors import PackError, reading, regular
from sundae_ns.io.budget import afford

# With Jupyter's packages jsonschema compiles a grammar for two seconds, of a format that no schema here has.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
import jsonschema  # noqa: E402

if sys.modules["rfc3987_syntax"] is None:
    del sys.modules["rfc3987_syntax"]

FORMAT: dict[str, Any] = json.loads(resources.files(__package__).joinpath("format.json").read_text(encoding="utf-8"))
"""``limits`` of files, schemas of ``container``, ``header`` and ``model``, and ``sections`` by codec and part."""
LIMITS: dict[str, int] = FORMAT["limits"]
VERSION, MAX_HEADER, SPARE, MAX_RATIO = (LIMITS[name] for name in ("version", "header", "spare", "ratio"))
MAGIC = b"\x89SUNDAE\n"
PADDING = "padding"
naming = partial(reading, kind="a whole packed scene", failure=PackError, remedy="get it again, or pack it again")
"""Turns every error of reading a packed scene into a ``PackError`` that names the file."""
_TRIED = 1 << 14  # bytes of a plane that tell whether to deflate it
_PREAMBLE = struct.Struct("<8sII32s")

Array = NDArray[Any]
Floats = NDArray[np.float32]
Levels = NDArray[np.int32]
Coded = tuple[dict[str, Any], Levels, dict[str, Array]]
"""The stored form of an attribute: its entry in the header, its levels ``[N, C]``, and its other sections by name."""


class Section(NamedTuple):
    """An array in the file, of ``size`` bytes, which is stored in parts of these lengths."""

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    parts: tuple[int, ...]
    sha256: str
    offset: int
    size: int


class Header(NamedTuple):
    """The header of a file of ``size`` bytes; ``meta`` is its JSON object, with ``sections``."""

    meta: dict[str, Any]
    sections: dict[str, Section]
    size: int


def _unique_by(_: Any, key: str | int, items: list[Any], __: Any) -> Iterator[jsonschema.ValidationError]:
    if len({item[key] for item in items}) < len(items):
        yield jsonschema.ValidationError(f"two items have the same {key}")


def _orthonormal(_: Any, __: bool, value: list[Any], ___: Any) -> Iterator[jsonschema.ValidationError]:
    rows = np.array([row[:3] for row in value] if isinstance(value[0], list) else [value], np.float64)
    crooked = np.abs(rows @ rows.T - np.eye(len(rows))).max() > 0.1  # poses of captures may be as far off
    if crooked or (len(rows) == 3 and np.linalg.det(rows) <= 0):
        yield jsonschema.ValidationError("the rows are not those of a rotation")


def _counts(_: Any, most: int, values: list[Any], __: Any) -> Iterator[jsonschema.ValidationError]:
    # A header may hold a million; "items" would take half a minute.
    if not all(type(value) in (int, float) and 0 <= value <= most and value == int(value) for value in values):
        yield jsonschema.ValidationError(f"they are not whole numbers from 0 to {most}")


_Validator = jsonschema.validators.extend(
    jsonschema.Draft202012Validator, {"uniqueBy": _unique_by, "orthonormal": _orthonormal, "counts": _counts}
)


def fault(value: Any, schema: Mapping[str, Any], prefix: str = "") -> str | None:
    """The first violation of a schema as dotted keys after ``prefix``; None for a valid value.

    Whole numbers may be written as ``3.0``, which JavaScript does not tell from ``3``.
    """
    # The first error only: own keywords come last in a schema, and rely on those before.
    if (error := next(_Validator(schema).iter_errors(value), None)) is None:
        return None
    keys = [prefix] if prefix else []
    keys += map(str, error.absolute_path)
    if error.validator == "required":
        keys.append(next(key for key in error.validator_value if key not in error.instance))
    return ".".join(keys)


def check(value: Any, schema: str) -> None:
    """Raise ``ValueError`` if a part of the header violates a schema of ``FORMAT``."""
    if (wrong := fault(value, FORMAT[schema])) is not None:
        raise ValueError(f"its header has no valid {wrong or schema}")


def parsed(content: bytes) -> Any:
    """A JSON value of UTF-8; ``ValueError`` if it is none, is nested too deeply, or has numbers beyond float64."""

    def finite(text: str) -> int | float:
        if not math.isfinite(float(text)):
            raise ValueError(f"{text} is beyond float64")
        return int(text) if text.lstrip("-").isdigit() else float(text)

    def check_depth(value: Any, left: int) -> None:
        if isinstance(value, (list, dict)):
            if left == 0:
                raise ValueError("its header is nested too deeply")
            for inner in value.values() if isinstance(value, dict) else value:
                check_depth(inner, left - 1)

    value = json.loads(content.decode(), parse_int=finite, parse_float=finite, parse_constant=finite)
    check_depth(value, LIMITS["depth"])
    return value


def fits(array: Array, section: Mapping[str, Any], lengths: Mapping[str, int]) -> bool:
    """Whether an array has dtype and shape of a section of ``FORMAT``; ``lengths`` are the sides that it names."""
    sides = [lengths.get(side, side) for side in section["shape"]]
    same = all(side is None or side == length for side, length in zip(sides, array.shape, strict=False))
    return array.dtype.str == section["dtype"] and array.ndim == len(sides) and same


def in_range(array: Array, section: Mapping[str, Any]) -> bool:
    """Whether all values are finite and in the range of a section; a list is a range for each column."""
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        return False
    lowest, highest = np.array(section.get("minimum", -np.inf)), np.array(section.get("maximum", np.inf))
    return bool(((array >= lowest) & (array <= highest)).all())


def _rows(shape: tuple[int, ...]) -> int:
    return shape[0] if len(shape) > 1 else 1


def split_planes(array: Array) -> list[bytes]:
    """The planes of an array."""
    if array.size == 0:
        return []
    rows, size = _rows(array.shape), array.dtype.itemsize
    numbers = np.ascontiguousarray(array).reshape(-1).view(np.uint8).reshape(rows, -1, size)
    return [plane.tobytes() for plane in numbers.transpose(0, 2, 1).reshape(rows * size, -1)]


def _deflated(plane: bytes) -> bytes:
    if len(plane) < 5 or (len(plane) > _TRIED and len(_deflated(plane[:_TRIED])) == _TRIED):
        return plane  # too short, or, like the entropy coder's, without redundancy
    deflate = zlib.compressobj(9, wbits=-15)
    stream = deflate.compress(plane) + deflate.flush()
    return stream if len(stream) < len(plane) else plane


def encode(meta: Mapping[str, Any], arrays: Mapping[str, Array], *, unpacked: int = 0) -> tuple[bytes, dict[str, int]]:
    """The bytes of a file, and the number of bytes of each of its sections; ``PackError`` if the header is too long.

    ``meta`` has JSON values for the header, ``arrays`` dtypes that ``format.json`` lists. A reader decodes ``unpacked``
    bytes from them, if more than their own size.
    """
    little = {name: array.astype(array.dtype.newbyteorder("<"), copy=False) for name, array in arrays.items()}
    parts = {name: [_deflated(plane) for plane in split_planes(array)] for name, array in little.items()}
    body = sum(len(part) for planes in parts.values() for part in planes)
    unpacked = max(unpacked, sum(array.nbytes for array in little.values()))
    if (lacking := (unpacked - SPARE) // MAX_RATIO + 1 - body) > 0:
        little[PADDING] = np.zeros(lacking, np.uint8)
        parts[PADDING] = [little[PADDING].tobytes()]
    stored = {name: b"".join(planes) for name, planes in parts.items()}
    sections = []
    for name, array in little.items():
        about = {"name": name, "dtype": array.dtype.newbyteorder("<").str, "shape": list(array.shape)}
        digest = hashlib.sha256(stored[name]).hexdigest()
        sections.append({**about, "parts": [len(part) for part in parts[name]], "sha256": digest})
    content = b"".join([_front({**meta, "sections": sections}), *stored.values()])
    return content, {name: len(section) for name, section in stored.items()}


def _front(meta: Mapping[str, Any]) -> bytes:
    """All bytes of a file before its sections."""
    header = json.dumps(meta, allow_nan=False, separators=(",", ":")).encode()
    if len(header) > MAX_HEADER:
        raise PackError(f"the header takes {len(header):,} bytes, readers accept {MAX_HEADER:,}; give fewer cameras")
    return _PREAMBLE.pack(MAGIC, VERSION, len(header), hashlib.sha256(header).digest()) + header


def restated(content: bytes, entries: Mapping[str, Any]) -> bytes:
    """A checked file with more entries in its header, or longer ones, which must not be ``sections``."""
    end = _PREAMBLE.size + _PREAMBLE.unpack_from(content)[2]
    return _front({**parsed(content[_PREAMBLE.size : end]), **entries}) + content[end:]


def read_header(path: Path) -> Header:
    """Read and check the header, without the sections; ``PackError`` if it is not that of a whole packed scene."""
    with naming(path), regular(path).open("rb") as file:
        size = path.stat().st_size
        preamble = file.read(_PREAMBLE.size)
        if preamble[: len(MAGIC)] != MAGIC:
            raise ValueError("it does not begin as what sundae pack writes")
        if len(preamble) < _PREAMBLE.size:
            raise ValueError("it ends before its header")
        _, version, length, digest = _PREAMBLE.unpack(preamble)
        if version != VERSION:
            remedy = "pack the run again" if version < VERSION else "update this program"
            raise PackError(f"{path} has version {version} of the format, this program reads {VERSION}; {remedy}")
        if length > min(MAX_HEADER, size - _PREAMBLE.size):
            raise ValueError("it ends in its header")
        text = file.read(length)
        if hashlib.sha256(text).digest() != digest:
            raise ValueError("the checksum of its header is wrong")
        meta = parsed(text)
        return Header(meta, _sections(meta, _PREAMBLE.size + length, size), size)


def _sections(meta: Any, offset: int, size: int) -> dict[str, Section]:
    check(meta, "container")
    sections: dict[str, Section] = {}
    for entry in meta["sections"]:
        shape, parts = (tuple(map(int, entry[key])) for key in ("shape", "parts"))
        dtype, name = np.dtype(entry["dtype"]), entry["name"]
        length = math.prod(shape) * dtype.itemsize
        planes = _rows(shape) * dtype.itemsize if length else 0
        if len(parts) != planes or max(parts, default=0) > length // max(planes, 1):
            raise ValueError(f"its header states impossible parts of {name}")
        sections[name] = Section(name, dtype, shape, parts, entry["sha256"], offset, length)
        offset += sum(parts)
    if offset != size:
        raise ValueError(f"its header states {offset:,} bytes, it has {size:,}")
    afford(sum(section.size for section in sections.values()), size, SPARE, MAX_RATIO)
    return sections


def read_sections(path: Path, header: Header) -> dict[str, Array]:
    """Read all sections except padding; ``PackError`` if one is altered or truncated."""
    with naming(path):
        content = memoryview(path.read_bytes())

        def decode(section: Section) -> Array:
            stored = content[section.offset : section.offset + sum(section.parts)]
            if hashlib.sha256(stored).hexdigest() != section.sha256:
                raise ValueError(f"the checksum of {section.name} is wrong")
            if section.size == 0 or section.name == PADDING:
                return np.zeros(section.shape, section.dtype)
            size, ends = section.size // len(section.parts), accumulate(section.parts)
            planes = [_inflated(stored[end - part : end], size) for end, part in zip(ends, section.parts)]
            table = np.frombuffer(b"".join(planes), np.uint8).reshape(_rows(section.shape), section.dtype.itemsize, -1)
            return np.ascontiguousarray(table.transpose(0, 2, 1)).reshape(-1).view(section.dtype).reshape(section.shape)

        with ThreadPoolExecutor(2) as pool:
            arrays = dict(zip(header.sections, pool.map(decode, header.sections.values()), strict=True))
        return {name: array for name, array in arrays.items() if name != PADDING}


def _inflated(part: memoryview, size: int) -> bytes:
    """A plane of ``size`` bytes; nothing may follow its stream."""
    if len(part) == size:
        return bytes(part)
    inflate = zlib.decompressobj(wbits=-15)
    with suppress(zlib.error):
        plane = inflate.decompress(part, size + 1)
        if len(plane) == size and inflate.eof and not inflate.unused_data:
            return plane
    raise ValueError("a section cannot be decompressed")
