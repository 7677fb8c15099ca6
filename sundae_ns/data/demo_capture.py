"""The capture of ``sundae demo``: a ray-traced still life, stored in ``demo_capture.zip`` beside this module."""

from __future__ import annotations

import zipfile
from pathlib import Path

from sundae_ns.core.errors import DataError

ARCHIVE = Path(__file__).with_name("demo_capture.zip")
"""48 training and 8 test images of 128 x 128 pixels, and 5,000 points."""
TRANSFORMS = "transforms.json"
MARKER = ".sundae_scene"
"""Its presence permits to replace the files of an earlier copy."""


def write_demo_capture(out: Path) -> Path:
    """Write the demo's capture as a nerfstudio data set to a folder; returns that folder, the value for ``--data``.

    An earlier copy is replaced. ``transforms.json`` comes last, so an interrupted copy has none.

    Raises:
        DataError: ``out`` is a file, or holds other files.
    """
    if out.exists() and not out.is_dir():
        raise DataError(f"{out} is a file; name a folder for the capture")
    if out.is_dir() and any(out.iterdir()) and not (out / MARKER).exists():
        raise DataError(f"{out} holds other files than the demo's capture; name a new or an empty folder")
    out.mkdir(parents=True, exist_ok=True)
    (out / MARKER).touch()
    (out / TRANSFORMS).unlink(missing_ok=True)
    with zipfile.ZipFile(ARCHIVE) as archive:
        for name in sorted(archive.namelist(), key=lambda name: (name == TRANSFORMS, name)):
            partial = out / f"{name}.partial"
            partial.parent.mkdir(exist_ok=True)
            partial.write_bytes(archive.read(name))
            partial.replace(out / name)
    return out
