"""Limits of time and memory for a reader of untrusted files."""

from __future__ import annotations

import re
import resource
import signal
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sundae_ns.core.errors import DataError, SundaeError

SECONDS = 5  # Limit of one case, in CPU time, so that other work on the machine does not count
BASE, FACTOR = 300 << 20, 20
"""Limit of one case: BASE bytes plus FACTOR bytes per byte of input."""


class Hang(BaseException):
    """Raised by the timer; a ``BaseException``, so that no reader catches it as an error of its input."""


def verdict(reader: Callable[[], Any], size: int) -> SundaeError | None:
    """Call a reader of ``size`` bytes within the limits; None on success, or the one-line error that it raised."""

    def stop(*_: Any) -> None:
        raise Hang

    capacity = BASE + FACTOR * size
    before = signal.signal(signal.SIGPROF, stop)
    limits = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    error: SundaeError | None = None
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    tracemalloc.start()
    try:
        # tracemalloc counts Python and numpy; the limit on addresses covers all others, such as torch.
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + capacity, limits[1]))
        reader()
    except SundaeError as raised:
        error = raised
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.signal(signal.SIGPROF, before)
    assert peak <= capacity, f"took {peak:,} bytes of memory for {size:,} bytes of input"
    if error is not None:
        assert "\n" not in str(error)
        assert 10 < len(str(error)) < 600
        # FFmpeg calls an absurd count a lack of memory, and asks for none.
        causes = [cause for cause in (error.__cause__, error.__context__) if type(cause).__module__ != "av.error"]
        assert not any(isinstance(cause, MemoryError) or "allocate memory" in str(cause) for cause in causes)
    return error


def refused(read: Callable[[Path], Any], path: Path, words: str = "", kind: type[SundaeError] = DataError) -> None:
    """Assert that a file is refused within the limits, in one line that has words (a pattern)."""
    error = verdict(lambda: read(path), path.stat().st_size if path.is_file() else 0)
    assert isinstance(error, kind), error
    assert re.search(words, str(error)), error
