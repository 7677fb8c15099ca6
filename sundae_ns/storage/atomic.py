"""Atomic writes: a file is written under another name, flushed to disk, and renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from sundae_ns.errors import writing

if TYPE_CHECKING:
    from PIL import Image


@contextmanager
def replacing(path: Path, partial: Path | None = None) -> Iterator[Path]:
    """Yield a path to write to; after the block, flush that file to disk and rename it to ``path``.

    If the process is killed or the machine loses power, ``path`` is either the earlier file or the complete new one. If
    the block raises, its file is removed and ``path`` is unchanged.

    Args:
        path: the file to write; its folder must exist.
        partial: temporary file in the same folder; by default named after this process.

    Raises:
        StorageError: the disk is full or not writable.
    """
    partial = partial or path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with writing(f"cannot write {path}"):
            yield partial
            flush(partial)
            partial.replace(path)
            flush(path.parent)
    finally:
        with suppress(OSError):
            partial.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a small text file atomically; ``StorageError`` if the disk is full or not writable."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically; ``StorageError`` if the disk is full or not writable."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def write_image(path: Path, image: Image.Image) -> None:
    """Write an image atomically in the format of its suffix; ``StorageError`` as for :func:`write_text`."""
    kind = path.suffix.lower()[1:]
    with replacing(path) as partial:
        image.save(partial, format={"jpg": "jpeg"}.get(kind, kind))


def put_aside(path: Path) -> None:
    """Rename a damaged file or folder, if there is one, to ``NAME.damaged``, in place of an earlier one."""
    aside = path.with_name(f"{path.name}.damaged")
    if not path.exists():
        return
    if aside.is_dir():
        shutil.rmtree(aside)
    path.replace(aside)


def flush(path: Path) -> None:
    """Wait until a file, or the entries of a folder, are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
