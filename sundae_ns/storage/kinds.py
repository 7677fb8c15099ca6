"""Kinds of files by their first bytes, for error messages that say what to give instead."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from sundae_ns.errors import CheckpointError, regular

Kind = Literal["packed", "ply", "spz", "sog"]
PACKED = b"\x89SUNDAE\n"
"""First bytes of a packed scene."""
_FIRST_BYTES: dict[bytes, Kind] = {
    PACKED: "packed",
    b"ply\n": "ply",
    b"ply\r": "ply",
    b"\x1f\x8b": "spz",
    b"NGSP": "spz",
    b"PK\x03\x04": "sog",
}


def kind_of(path: Path) -> Kind | None:
    """Kind of the file at a path; None for any other file, a folder or a missing file."""
    try:
        with regular(path).open("rb") as file:
            first = file.read(max(map(len, _FIRST_BYTES)))
    except OSError:
        return None
    kind = next((kind for begin, kind in _FIRST_BYTES.items() if first.startswith(begin)), None)
    # A checkpoint is a zip file too.
    return None if kind == "sog" and path.suffix.lower() != ".sog" else kind


def refuse(path: Path, *, packed: str | None = None, ply: str | None = None) -> None:
    """Raise ``CheckpointError`` for a packed scene or a .ply, with the advice for it; None accepts the kind."""
    kind = kind_of(path)
    if kind == "packed" and packed is not None:
        raise CheckpointError(f"{path} is a packed scene; {packed}")
    if kind == "ply" and ply is not None:
        raise CheckpointError(f"{path} is a .ply file; {ply}")
