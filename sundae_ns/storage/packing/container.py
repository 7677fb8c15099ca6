"""A file of named arrays behind a JSON header: all bytes are under checksums, and none can be executed.

``docs/formats.md`` gives the layout. Readers check sizes before they allocate: all sections together may unpack to at
most ``SPARE`` bytes plus ``MAX_RATIO`` bytes per byte of the file. If they unpack to more, the writer adds a section
``padding``.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from sundae_ns.errors import PackError, regular
from sundae_ns.storage.kinds import PACKED
from sundae_ns.storage.packing import zstd
from sundae_ns.storage.packing.schema import FORMAT, LIMITS, fault, parsed

VERSION, MAX_HEADER = LIMITS["version"], LIMITS["header"]
SPARE, MAX_RATIO = LIMITS["spare"], LIMITS["ratio"]
PADDING = "padding"
_PREAMBLE = struct.Struct("<8sII32s")
_THREADS = 2
_LEVEL = 19

Array = NDArray[Any]
Floats = NDArray[np.float32]
Levels = NDArray[np.int32]
Coded = tuple[dict[str, Any], Levels, dict[str, Array]]
"""The stored form of an attribute: its entry in the header, its levels ``[N, C]``, and its other sections by name."""


class DamagedError(PackError):
    """What is wrong with a packed scene, in words that do not name the file."""


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turn a ``DamagedError`` or ``OSError`` into a ``PackError`` that names the file."""
    try:
        yield
    except DamagedError as error:
        raise PackError(f"{path} is not a whole packed scene ({error}); get it again, or pack it again") from error
    except OSError as error:
        raise PackError(f"{path} cannot be read ({error.strerror or error}); check the path") from error


class Section(NamedTuple):
    """An array in the file."""

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    parts: tuple[int, ...]
    sha256: str
    offset: int

    @property
    def length(self) -> int:
        """Bytes in the file."""
        return sum(self.parts)

    @property
    def size(self) -> int:
        """Bytes of the array."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def planes(self) -> int:
        """Number of planes of the array."""
        return _rows(self.shape) * self.dtype.itemsize


class Header(NamedTuple):
    """The header of a file."""

    meta: dict[str, Any]
    """The JSON object, ``sections`` included."""
    sections: dict[str, Section]
    size: int
    """Bytes of the file."""


def _rows(shape: tuple[int, ...]) -> int:
    return shape[0] if len(shape) > 1 else 1


def _split(array: Array) -> list[bytes]:
    """Split an array into planes."""
    if array.size == 0:
        return []
    flat = np.ascontiguousarray(array).reshape(_rows(array.shape), -1)
    planes = flat.view(np.uint8).reshape(flat.shape[0], flat.shape[1], array.dtype.itemsize)
    return [plane.tobytes() for plane in planes.transpose(0, 2, 1).reshape(-1, flat.shape[1])]


def _join(planes: Sequence[bytes | NDArray[np.uint8]], section: Section) -> Array:
    """Join planes that :func:`_split` returned."""
    if not planes:
        return np.zeros(section.shape, section.dtype)
    size = section.dtype.itemsize
    if len(planes) == 1:
        return np.frombuffer(planes[0], section.dtype).reshape(section.shape)
    rows = _rows(section.shape)
    table = np.empty((rows, math.prod(section.shape) // rows, size), np.uint8)
    for i, plane in enumerate(planes):
        table[i // size, :, i % size] = np.frombuffer(plane, np.uint8)
    return table.reshape(-1).view(section.dtype).reshape(section.shape)


def _compress(plane: bytes) -> bytes:
    frame = zstandard.ZstdCompressor(level=_LEVEL, write_checksum=False).compress(plane)
    return frame if len(frame) < len(plane) else plane


def _decompress(part: memoryview, size: int) -> bytes | NDArray[np.uint8]:
    """Decompress a plane of ``size`` bytes."""
    if len(part) == size:
        return bytes(part)
    try:
        return zstd.decompress(bytes(part), size)
    except ValueError as error:
        raise DamagedError("a section cannot be decompressed") from error


def encode(meta: Mapping[str, Any], arrays: Mapping[str, Array], *, unpacked: int = 0) -> tuple[bytes, dict[str, int]]:
    """The bytes of a file, and the number of bytes of each of its sections.

    Args:
        meta: JSON values for the header, without the key ``sections``.
        arrays: arrays of the dtypes that ``format.json`` lists.
        unpacked: bytes that a reader decodes from the arrays, if more than their own size.

    Raises:
        PackError: the header is too long for a reader.
    """
    named = {name: np.asarray(array) for name, array in arrays.items()}

    def compressed(array: Array) -> list[bytes]:
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        return [_compress(plane) for plane in _split(little)]

    with ThreadPoolExecutor(_THREADS) as pool:
        parts = dict(zip(named, pool.map(compressed, named.values()), strict=True))
    body = sum(len(part) for planes in parts.values() for part in planes)
    size = max(unpacked, sum(array.nbytes for array in named.values()))
    lacking = (size - SPARE) // MAX_RATIO + 1 - body
    if lacking > 0:
        named[PADDING] = np.zeros(lacking, np.uint8)
        parts[PADDING] = [named[PADDING].tobytes()]
    sections = [_entry(name, array, parts[name]) for name, array in named.items()]
    content = b"".join(
        [_front({**meta, "sections": sections}), *(part for planes in parts.values() for part in planes)]
    )
    return content, {name: sum(map(len, planes)) for name, planes in parts.items()}


def _front(meta: Mapping[str, Any]) -> bytes:
    """All bytes of a file before its sections."""
    header = json.dumps(meta, allow_nan=False, separators=(",", ":")).encode()
    if len(header) > MAX_HEADER:
        raise PackError(
            f"the header takes {len(header):,} bytes, but readers accept {MAX_HEADER:,}; give fewer cameras"
        )
    return _PREAMBLE.pack(PACKED, VERSION, len(header), hashlib.sha256(header).digest()) + header


def restated(content: bytes, entries: Mapping[str, Any]) -> bytes:
    """A checked file with other entries of its header, which must not be ``sections``; its sections stay as they are.

    The file may not become so much shorter that its sections unpack to too much; an entry more is always right.
    """
    length = _PREAMBLE.unpack_from(content)[2]
    end = _PREAMBLE.size + length
    return _front({**parsed(content[_PREAMBLE.size : end]), **entries}) + content[end:]


def _entry(name: str, array: Array, parts: list[bytes]) -> dict[str, Any]:
    return {
        "name": name,
        "dtype": array.dtype.newbyteorder("<").str,
        "shape": list(array.shape),
        "parts": [len(part) for part in parts],
        "sha256": hashlib.sha256(b"".join(parts)).hexdigest(),
    }


def read_header(path: Path) -> Header:
    """Read and check the header, without the sections.

    Raises:
        PackError: the file is not a packed scene, of another version, truncated, altered, or states impossible sizes.
    """
    with naming(path), regular(path).open("rb") as file:
        size = path.stat().st_size
        preamble = file.read(_PREAMBLE.size)
        if preamble[: len(PACKED)] != PACKED:
            raise PackError(f"{path} is not a packed scene; give a file that sundae pack wrote")
        if len(preamble) < _PREAMBLE.size:
            raise DamagedError("it ends before its header")
        _, version, length, digest = _PREAMBLE.unpack(preamble)
        if version != VERSION:
            raise PackError(f"{path} has version {version} of the format, this program reads {VERSION}; update it")
        if length > min(MAX_HEADER, size - _PREAMBLE.size):
            raise DamagedError("it ends in its header")
        text = file.read(length)
        if hashlib.sha256(text).digest() != digest:
            raise DamagedError("the checksum of its header is wrong")
        try:
            meta = parsed(text)
        except ValueError as error:
            raise DamagedError("its header is not JSON") from error
        return Header(meta, _sections(meta, _PREAMBLE.size + length, size), size)


def check(value: Any, schema: str, place: str = "") -> None:
    """Raise ``DamagedError`` if a part of the header, at a place in dotted keys, violates a schema of ``FORMAT``."""
    found = fault(value, FORMAT[schema], place)
    if found is not None:
        raise DamagedError(f"its header has no valid {found or schema}")


def _sections(meta: Any, offset: int, size: int) -> dict[str, Section]:
    check(meta, "container")
    sections: dict[str, Section] = {}
    for entry in meta["sections"]:
        shape, parts = (tuple(map(int, entry[key])) for key in ("shape", "parts"))
        section = Section(entry["name"], np.dtype(entry["dtype"]), shape, parts, entry["sha256"], offset)
        longest = section.size // section.planes if section.size else 0
        if len(parts) != (section.planes if section.size else 0) or max(parts, default=0) > longest:
            raise DamagedError(f"its header states impossible parts of {section.name}")
        sections[section.name] = section
        offset += section.length
    if offset != size:
        raise DamagedError(f"its header states {offset:,} bytes, it has {size:,}")
    check_ratio(sum(section.size for section in sections.values()), size)
    return sections


def check_ratio(unpacked: int, size: int) -> None:
    """Raise ``DamagedError`` if a file of ``size`` bytes may not unpack to ``unpacked`` bytes."""
    if unpacked > SPARE + MAX_RATIO * size:
        raise DamagedError(f"{size:,} bytes would unpack to {unpacked:,}")


def read_sections(path: Path, header: Header) -> dict[str, Array]:
    """Read all sections except padding; ``PackError`` if one is altered or truncated."""
    with naming(path):
        content = memoryview(path.read_bytes())
        for section in header.sections.values():
            stored = content[section.offset : section.offset + section.length]
            if hashlib.sha256(stored).hexdigest() != section.sha256:
                raise DamagedError(f"the checksum of {section.name} is wrong")

        def decode(section: Section) -> Array:
            planes, start = [], section.offset
            for part in section.parts:
                planes.append(_decompress(content[start : start + part], section.size // section.planes))
                start += part
            return _join(planes, section)

        wanted = [section for section in header.sections.values() if section.name != PADDING]
        with ThreadPoolExecutor(_THREADS) as pool:
            return dict(zip([section.name for section in wanted], pool.map(decode, wanted), strict=True))
