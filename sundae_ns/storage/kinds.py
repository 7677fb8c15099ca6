"""What a file is by its first bytes, whatever its name: commands tell a user what they were given, and what to give."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from sundae_ns.errors import CheckpointError
from sundae_ns.storage.packing.container import MAGIC

Kind = Literal["packed", "ply"]

_FIRST_BYTES: dict[bytes, Kind] = {MAGIC: "packed", b"ply\n": "ply", b"ply\r": "ply"}
_NAMES: dict[Kind, str] = {"packed": "a packed scene", "ply": "a .ply file"}


def kind_of(path: Path) -> Kind | None:
    """What a path leads to: a packed scene, a .ply, or None for anything else, a folder and nothing at all among them."""
    try:
        with path.open("rb") as file:
            first = file.read(max(map(len, _FIRST_BYTES)))
    except OSError:
        return None
    return next((kind for begin, kind in _FIRST_BYTES.items() if first.startswith(begin)), None)


def refuse(path: Path, *, packed: str | None = None, ply: str | None = None) -> None:
    """Refuse a file of a kind that cannot be used here.

    Args:
        path: what a user gave.
        packed: what to give instead of a packed scene; None where one is as good as anything else.
        ply: what to give instead of a .ply; likewise.

    Raises:
        CheckpointError: it is a file of a kind that something else is to be given for.
    """
    advice: dict[Kind, str | None] = {"packed": packed, "ply": ply}
    kind = kind_of(path)
    if kind is not None and (instead := advice[kind]) is not None:
        raise CheckpointError(f"{path} is {_NAMES[kind]}; {instead}")
