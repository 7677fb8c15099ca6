"""Locks on open files, which the system drops when the process ends: ``flock``, or a locked byte on Windows."""

from __future__ import annotations

import errno
import os
from typing import IO, Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
try:
    import msvcrt
except ImportError:  # elsewhere
    msvcrt = None  # type: ignore[assignment]

_PLACE = 1 << 30
"""The byte that Windows locks: far behind the text, because others cannot read a locked byte there."""
_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK)
"""Reasons for which a lock is refused because another process holds one."""


def lock(file: IO[Any], *, shared: bool = False) -> bool:
    """Lock an open file without waiting; the lock lasts while a process has it open, on Windows this process.

    Args:
        file: with a descriptor.
        shared: other shared locks are no hindrance; on Windows, there are only exclusive ones.

    Returns:
        Whether the system has such locks for this file; network file systems may have none.

    Raises:
        BlockingIOError: another process holds a lock.
    """
    try:
        if fcntl is not None:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        elif msvcrt is not None:
            _lock_byte(file.fileno())
        else:
            return False
    except OSError as error:
        if error.errno in _TAKEN:
            raise BlockingIOError(error.errno, "locked by another process") from error
        if error.errno in (errno.ENOLCK, errno.ENOTSUP):
            return False
        raise
    return True


def _lock_byte(handle: int) -> None:
    """Lock a byte with the functions of Windows, which lock at the position of a file."""
    position = os.lseek(handle, 0, os.SEEK_CUR)
    os.lseek(handle, _PLACE, os.SEEK_SET)
    try:
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    finally:
        os.lseek(handle, position, os.SEEK_SET)
