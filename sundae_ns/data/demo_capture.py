"""The capture of ``sundae demo``: a ray-traced still life, stored in ``demo_capture.zip`` beside this module."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path

from sundae_ns.errors import DataError

ARCHIVE = Path(__file__).with_name("demo_capture.zip")
"""48 training and 8 test images of 128 x 128 pixels, and 5,000 points; ``benchmarks/still_life.py`` makes it."""
TRANSFORMS = "transforms.json"
MARKER = ".sundae_scene.json"
"""Lists the files of a copy; its presence permits to replace them. Written first."""
PARTIAL = ".partial"
"""End of the name of a file that is being written."""


def write_demo_capture(out: Path) -> Path:
    """Write the demo's capture as a nerfstudio data set to a folder; returns that folder, the value for ``--data``.

    An earlier copy is replaced. ``transforms.json`` comes last, so an interrupted copy has none.

    Raises:
        DataError: ``out`` is a file, or holds other files.
    """
    with zipfile.ZipFile(ARCHIVE) as archive:
        names = sorted(archive.namelist(), key=lambda name: (name == TRANSFORMS, name))
        _claim(out, names)
        for name in names:
            (out / name).parent.mkdir(exist_ok=True)
            _replace(out / name, archive.read(name))
    return out


def _claim(out: Path, files: Sequence[str]) -> None:
    """Create ``out`` with its marker, or clear the files of an earlier copy; refuse any other folder."""
    marker = out / MARKER
    if out.exists() and not out.is_dir():
        raise DataError(f"{out} is a file; name a folder for the capture")
    if marker.exists():
        try:
            stale = [str(name) for name in json.loads(marker.read_text(encoding="utf-8"))["files"]]
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"{marker} is damaged; remove it and the capture in {out}, or name another folder"
            ) from error
        for name in [*stale, TRANSFORMS]:
            # An edited marker must not delete files outside its folder.
            if (out / name).resolve().is_relative_to(out.resolve()):
                (out / name).unlink(missing_ok=True)
    elif out.is_dir() and any(path.name != MARKER + PARTIAL for path in out.iterdir()):
        raise DataError(f"{out} holds other files than the demo's capture; name a new or an empty folder")
    out.mkdir(parents=True, exist_ok=True)
    _replace(marker, json.dumps({"files": list(files)}, indent=1).encode())


def _replace(path: Path, content: bytes) -> None:
    """Write a file beside its place and rename it, so that an interrupted copy has no half file."""
    partial = path.with_name(path.name + PARTIAL)
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
