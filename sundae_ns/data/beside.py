"""The file that a missing one is probably meant to be."""

from __future__ import annotations

import difflib
from pathlib import Path

_PHOTOS = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic"}
_MOST_ENTRIES = 10_000
_MOST_COMPARED = 1000
"""Names that are compared letter by letter."""


def beside(path: Path) -> str:
    """A remark on the file that a missing one is probably meant to be, `` (there is Cameras.bin)``; else empty."""
    wanted, names = path.name, [entry.name for entry in entries(path.parent)]
    if wanted in names:
        return ""
    same = [name for name in names if name.lower() == wanted.lower()]
    longer = [name for name in names if name.lower().startswith(wanted.lower() + ".")]
    others = [
        name
        for name in names
        if path.suffix.lower() in _PHOTOS
        and Path(name).suffix.lower() in _PHOTOS
        and Path(name).stem.lower() == path.stem.lower()
    ]
    close = difflib.get_close_matches(wanted, names[:_MOST_COMPARED], n=1, cutoff=0.9)
    # Names of frames differ in a digit; another frame is not meant.
    close = [name for name in close if not _numbered(name, wanted)]
    found = next(iter([*same, *longer, *others, *close]), None)
    return "" if found is None else f" (there is {found})"


def _numbered(name: str, other: str) -> bool:
    """Whether two names differ in digits only."""
    blank = str.maketrans("0123456789", "#" * 10)
    return name.translate(blank) == other.translate(blank)


def entries(folder: Path) -> list[Path]:
    """Contents of a folder in their order, not more than some thousands; empty if there is no such folder."""
    try:
        return sorted(folder.iterdir())[:_MOST_ENTRIES]
    except OSError:
        return []


def unused_masks(folder: Path) -> str | None:
    """Name of a folder of masks in a capture, if it has one with images."""
    for name in ("masks", "mask"):
        if any(entry.suffix.lower() in _PHOTOS for entry in entries(folder / name)):
            return name
    return None
