"""Files that are whole or not there: written beside their place, flushed to disk, and renamed."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sundae_ns.errors import StorageError

_MENDS = {
    errno.ENOSPC: "the disk is full; make room",
    errno.EDQUOT: "the disk quota is used up; make room",
    errno.EFBIG: "the file is larger than this process may write; raise the limit (ulimit -f)",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.EACCES: "permission denied; choose another folder, or give yourself the right to write there",
    errno.EPERM: "not permitted; choose another folder",
    errno.ENOTDIR: "a file stands where a folder should be; choose another folder",
    errno.EEXIST: "a file stands where a folder should be; choose another folder",
    errno.EIO: "the disk reports an error; check it, and choose another",
}


def storage_error(what: str, error: OSError) -> StorageError | None:
    """The error of ours for a file that could not be written, or None where ``error`` is of another kind.

    Args:
        what: what failed, without a full stop: ``"cannot write a.ply"``.
        error: what the system said.
    """
    mend = _MENDS.get(error.errno or 0)
    return None if mend is None else StorageError(f"{what}: {mend}")


@contextmanager
def writing(what: str) -> Iterator[None]:
    """Turn an error of the file system that a user can mend into one of ours; others pass.

    Args:
        what: what fails then, without a full stop: ``"cannot make runs/a"``.

    Raises:
        StorageError: the disk is full, or may not be written to.
    """
    try:
        yield
    except OSError as error:  # ours, which have no number, pass too
        ours = storage_error(what, error)
        if ours is None:
            raise
        raise ours from error


@contextmanager
def replacing(path: Path, partial: Path | None = None) -> Iterator[Path]:
    """Yield a path to write to; after the block it is flushed to disk and takes the place of ``path`` in one step.

    A process that is killed, or a machine that loses power, leaves either the file that was there before or the new one.
    If the block raises, what it wrote is removed and ``path`` stays as it was.

    Args:
        path: the file to write; its folder must exist.
        partial: where it grows, in the same folder; by default a name of this process.

    Raises:
        StorageError: the disk is full, or may not be written to.
    """
    partial = partial or path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with writing(f"cannot write {path}"):
            yield partial
            _flush(partial)
            partial.replace(path)
            _flush(path.parent)
    finally:
        with suppress(OSError):
            partial.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a small text file, whole or not at all.

    Raises:
        StorageError: the disk is full, or may not be written to.
    """
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _flush(path: Path) -> None:
    """Wait until a file, or a folder's list of names, is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
