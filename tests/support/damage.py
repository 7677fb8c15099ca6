"""Damage for files of every kind: of their bytes, and of what is under their checksums and compression."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable

import hypothesis.strategies as st
from packed_scenes import header_and_body, resealed, sealed

Change = Callable[[bytes], bytes]
_VALUES = [b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\0" * 8, b"99999999", b"-1", b"1e999", b"null", b"[]", b"NaN", b"{"]


@st.composite
def damage(draw: st.DrawFn) -> Change:
    """One change of the bytes of a file; half of them are near its start, which holds counts and types."""
    kind = draw(st.sampled_from(["cut", "flip", "replace", "delete", "repeat"]))
    at_start, where = draw(st.booleans()), draw(st.integers(0, (1 << 20) - 1)) / (1 << 20)
    length = draw(st.sampled_from([1, 7, 64, 1000])) if kind in ("delete", "repeat") else 0
    values = draw(st.sampled_from(_VALUES) | st.binary(min_size=1)) if kind == "replace" else b""
    bits = draw(st.binary(min_size=3, max_size=90)) if kind == "flip" else b""

    def change(content: bytes) -> bytes:
        data, size = bytearray(content), min(len(content), 80) if at_start else len(content)
        i = int(where * size)
        if kind == "cut":
            return content[:i]
        if kind == "flip" and size:
            for high, low, bit in zip(bits[::3], bits[1::3], bits[2::3]):
                data[(high << 8 | low) * size >> 16] ^= 1 << bit % 8
        elif kind == "replace":
            data[i : i + len(values)] = values
        elif kind == "delete":
            del data[i : i + length]
        elif kind == "repeat":
            data[i:i] = data[i : i + length]
        return bytes(data)

    return change


def _in_zip(content: bytes, change: Change, part: int) -> bytes:
    """One entry is changed; all have right checksums."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(out, "w") as target:
        for i, name in enumerate(names := source.namelist()):
            data = source.read(name)
            target.writestr(name, change(data) if i == part % len(names) else data)
    return out.getvalue()


def _in_glb(content: bytes, change: Change, part: int) -> bytes:
    """The document or the buffer is changed; their lengths are right."""
    (length,) = struct.unpack("<I", content[12:16])
    chunks = [content[20 : 20 + length], content[28 + length :]]
    chunks[part % 2] = change(chunks[part % 2])
    kinds = zip(chunks, (0x4E4F534A, 0x004E4942), strict=True)
    body = b"".join(struct.pack("<II", len(chunk), kind) + chunk for chunk, kind in kinds)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def _in_pack(content: bytes, change: Change, part: int) -> bytes:
    """The header or the sections are changed; all checksums are right."""
    meta, body = header_and_body(content)
    if part % 2:
        return sealed(change(json.dumps(meta).encode()), body)
    return resealed(meta, change(body)[: len(body)].ljust(len(body), b"\0"))


INSIDE: dict[str, Callable[[bytes, Change, int], bytes]] = {
    ".glb": _in_glb,
    ".sundae": _in_pack,
    ".spz": lambda content, change, _: gzip.compress(change(gzip.decompress(content))),
    **dict.fromkeys((".sog", ".pt", ".ckpt"), _in_zip),
}
"""How to change what a file of a kind has inside; the number chooses a part of it."""
