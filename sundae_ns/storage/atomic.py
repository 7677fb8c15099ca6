"""Atomic writes: a file is written under another name, flushed to disk, and renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING

from sundae_ns.errors import writing
from sundae_ns.storage.locks import lock

if TYPE_CHECKING:
    from PIL import Image

PARTIAL = ".partial"
"""Suffix of files that are not complete yet."""
_WINDOWS = os.name == "nt"


@contextmanager
def replacing(path: Path, partial: Path | None = None) -> Iterator[Path]:
    """Yield a path to write to; after the block, flush that file to disk and rename it to ``path``.

    If the process is killed or the machine loses power, ``path`` is either the earlier file or the complete new one. If
    the block raises, its file is removed and ``path`` is unchanged.

    Args:
        path: the file to write; a missing folder of it is made.
        partial: temporary file in the same folder. By default named after this process, and such files of killed
            processes are removed.

    Raises:
        StorageError: the disk is full or not writable.
    """
    owned = partial is None
    partial = partial or path.with_name(f"{path.name}.{os.getpid()}{PARTIAL}")
    try:
        with writing(f"cannot write {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
        with writing(f"cannot write {path}"), _reserved(path, partial) if owned else nullcontext():
            yield partial
            flush(partial)
            partial.replace(path)
            flush(path.parent)
    finally:
        with suppress(OSError):
            partial.unlink()


@contextmanager
def _reserved(path: Path, partial: Path) -> Iterator[None]:
    """Hold a lock on the partial file, and remove those of killed processes: the system drops a lock with its process.

    Where the file system has no locks, none is removed; nor on Windows, which renames no file that is open.
    """
    if _WINDOWS:
        yield
        return
    for other in path.parent.glob(f"{escape(path.name)}.*{PARTIAL}"):
        if not other.name[len(path.name) + 1 : -len(PARTIAL)].isdigit():  # of a file with a longer name
            continue
        with suppress(OSError), other.open("rb") as file:
            if lock(file):
                other.unlink()
    with partial.open("wb") as file:
        with suppress(OSError):
            lock(file)
        yield


def write_text(path: Path, text: str) -> None:
    """Write a small text file atomically; ``StorageError`` if the disk is full or not writable."""
    write_files({path: text.encode()})


def write_files(contents: Mapping[Path, bytes]) -> None:
    """Write files that belong together: all, or none if the disk is full or not writable, a ``StorageError``."""
    with ExitStack() as stack:
        for partial, content in [(stack.enter_context(replacing(path)), one) for path, one in contents.items()]:
            partial.write_bytes(content)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically; ``StorageError`` if the disk is full or not writable."""
    write_files({path: content})


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
    """Wait until a file, or the entries of a folder, are on the disk; Windows does not open folders."""
    if _WINDOWS and path.is_dir():
        return
    handle = os.open(path, os.O_RDWR if _WINDOWS else os.O_RDONLY)  # Windows flushes only what it may write
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
