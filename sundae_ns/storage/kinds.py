"""Kinds of files by their first bytes, for error messages that say what to give instead."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from sundae_ns.errors import CheckpointError, regular

Kind = Literal["packed", "ply", "spz", "sog", "glb", "splat", "ksplat", "gsplat"]
PRIMITIVES: dict[Kind, str] = {
    "ply": ".ply file",
    "spz": ".spz file",
    "sog": ".sog file",
    "glb": ".glb file",
    "splat": ".splat file",
    "ksplat": ".ksplat file",
    "gsplat": "checkpoint of gsplat",
}
"""Kinds of files that hold primitives alone, and their names."""
PACKED = b"\x89SUNDAE\n"
"""First bytes of a packed scene."""
_FIRST_BYTES: dict[bytes, Kind] = {
    PACKED: "packed",
    b"ply\n": "ply",
    b"ply\r": "ply",
    b"\x1f\x8b": "spz",
    b"NGSP": "spz",
    b"PK\x03\x04": "sog",
    b"glTF": "glb",
}
_HEADERLESS: dict[str, Kind] = {".splat": "splat", ".ksplat": "ksplat"}
"""Kinds without first bytes of their own, by suffix."""
_ZIPS: dict[str, Kind] = {".sog": "sog", ".pt": "gsplat"}
_BY_SUFFIX: dict[str, Kind] = {
    **{".ply": "ply", ".spz": "spz", ".sog": "sog", ".glb": "glb", ".pt": "gsplat"},
    **_HEADERLESS,
}
_UNREAD = {
    ".lcc": "is a scene of XGRIDS; convert it to .ply with SuperSplat or splat-transform",
    ".rad": "is a scene of Spark; convert the .ply that it was made of",
    ".gltf": "is a glTF scene in several files; export it as .glb",
    ".pth": "is a checkpoint of another trainer; give its .ply, such as point_cloud/iteration_*/point_cloud.ply",
}


def kind_of(path: Path) -> Kind | None:
    """Kind of the file at a path; None for any other file, a folder or a missing file."""
    try:
        with regular(path).open("rb") as file:
            first = file.read(max(map(len, _FIRST_BYTES)))
    except OSError:
        return None
    kind = next((kind for begin, kind in _FIRST_BYTES.items() if first.startswith(begin)), None)
    if kind == "sog":  # a checkpoint is a zip file too
        return _ZIPS.get(path.suffix.lower())
    return _HEADERLESS.get(path.suffix.lower()) if kind is None else kind


def kind_of_primitives(path: Path) -> Kind | None:
    """Kind of a file of primitives, of a missing or damaged one by its suffix; None for all others.

    A .sog may be a folder of images, or the ``meta.json`` in it.
    """
    if path.name == "meta.json" or ((path / "meta.json").is_file() and not (path / "config.yml").exists()):
        return "sog"
    kind = kind_of(path)
    if kind is None and not path.is_dir():
        kind = _BY_SUFFIX.get(path.suffix.lower())
    return kind if kind in PRIMITIVES else None


def unread(path: Path) -> str | None:
    """What a scene is that this program does not read, and how to convert it; None for any other path.

    >>> unread(Path("garden.lcc"))
    'is a scene of XGRIDS; convert it to .ply with SuperSplat or splat-transform'
    """
    if path.is_dir():
        # The folder of a training by the authors of 3DGS.
        found = sorted(path.glob("point_cloud/iteration_*/point_cloud.ply"), key=lambda each: each.stat().st_mtime)
        return f"is a folder of 3DGS; give {found[-1]}" if found else None
    return _UNREAD.get(path.suffix.lower())


def refuse(path: Path, *, packed: str | None = None, primitives: str | None = None) -> None:
    """Raise ``CheckpointError`` for a packed scene or a file of primitives, with the advice for it; None accepts it."""
    kind = kind_of(path)
    if kind == "packed" and packed is not None:
        raise CheckpointError(f"{path} is a packed scene; {packed}")
    if kind in PRIMITIVES and primitives is not None:
        raise CheckpointError(f"{path} is a {PRIMITIVES[kind]}; {primitives}")
    if kind is None and (other := unread(path)) is not None:
        raise CheckpointError(f"{path} {other}")
