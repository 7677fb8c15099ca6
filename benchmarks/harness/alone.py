"""Whether a job has its GPU to itself; times of others mean nothing."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import torch


@contextmanager
def watched_gpu() -> Iterator[Callable[[], bool]]:
    """:func:`watched` for the GPU of this process; a job on a CPU counts as alone.

    Only jobs of comparisons that this user runs on this machine are seen, not other programs.
    """
    if not torch.cuda.is_available():
        yield lambda: True
        return
    device = torch.cuda.current_device()
    name = getattr(torch.cuda.get_device_properties(device), "uuid", device)
    with watched(
        Path(tempfile.gettempdir()) / f"sundae-bench-{os.getuid() if os.name == 'posix' else ''}-{name}"
    ) as alone:
        yield alone


@contextmanager
def watched(path: Path) -> Iterator[Callable[[], bool]]:
    """Hold a device's file while a job runs; the value tells whether no other job has held it since the block began.

    Every job adds a byte to the file: a job that ends before this one is noticed too. On Windows files have no such
    locks, and every job counts as alone.

    Args:
        path: a file for each device.
    """
    with path.open("ab") as file:
        first = _lock(file)
        file.write(b".")
        file.flush()
        length = path.stat().st_size
        yield lambda: first and path.stat().st_size == length


def _lock(file: IO[bytes]) -> bool:
    """Share a file's lock, which the system releases when the process ends; whether nobody else had it."""
    if os.name != "posix":
        return True
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fcntl.flock(file, fcntl.LOCK_SH)
        return False
    fcntl.flock(file, fcntl.LOCK_SH)
    return True
