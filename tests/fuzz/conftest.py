"""Bad input: a reader either succeeds or says in one line what is wrong, soon and in little memory.

A reader gets its corpus in a file of its own, ``test_<kind>.py``: a good input made by the package, harmed by ``harmed`` or
by hand, one test a case, judged by ``verdict``. A new format (packed scenes) takes one more such file.
"""

from __future__ import annotations

import resource
import signal
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest

from sundae_ns.errors import SundaeError

SECONDS = 30
"""Longest time for one case: a hang, for cases that take milliseconds."""
BASE, FACTOR = 24 << 20, 40
"""Memory for one case: this many bytes, and this many a byte of input."""


class Hang(BaseException):
    """Raised by the clock; no reader can mistake it for an error of its input."""


@pytest.fixture
def verdict(record_property: Callable[[str, object], None]) -> Callable[..., SundaeError | None]:
    """Call a reader under limits of time and memory: None if it succeeded, or the error of ours in which it ended.

    ``benchmarks/corpus.py`` counts what is recorded.
    """

    def stop(*_: Any) -> None:
        raise Hang

    def judge(reader: Callable[[], Any], size: int) -> SundaeError | None:
        room = BASE + FACTOR * size
        before = signal.signal(signal.SIGALRM, stop)
        limits = resource.getrlimit(resource.RLIMIT_AS)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        error: SundaeError | None = None
        signal.alarm(SECONDS)
        tracemalloc.start()
        try:
            # Python and numpy are counted; the limit on addresses holds for all others, torch among them.
            resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (256 << 20) + room, limits[1]))
            reader()
        except SundaeError as raised:
            error = raised
        finally:
            signal.alarm(0)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            resource.setrlimit(resource.RLIMIT_AS, limits)
            signal.signal(signal.SIGALRM, before)
        assert peak <= room, f"took {peak:,} bytes of memory for {size:,} bytes of input"
        record_property("verdict", "success" if error is None else type(error).__name__)
        if error is not None:
            assert "\n" not in str(error)
            assert 10 < len(str(error)) < 600
            causes = [error.__cause__, error.__context__]
            assert not any(isinstance(cause, MemoryError) or "allocate memory" in str(cause) for cause in causes)
        return error

    return judge


@pytest.fixture(scope="session")
def harmed() -> Callable[[bytes, int], bytes]:
    """One of several harms to a file, chosen by a seed: cut, bits flipped, bytes replaced, parts doubled or dropped."""

    def harm(content: bytes, seed: int) -> bytes:
        rng = Random(seed)
        data = bytearray(content)
        kind = seed % 6
        if kind == 0:
            return bytes(data[: rng.randrange(len(data))])
        if kind == 1:
            for _ in range(rng.choice((1, 3, 30))):
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        elif kind == 2:  # in the first bytes, where counts and kinds stand
            for _ in range(rng.choice((1, 4))):
                data[rng.randrange(min(len(data), 80))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        elif kind == 3:  # a count, a length or a number of the largest kind
            start = rng.randrange(len(data))
            data[start : start + 8] = rng.choice((b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\x00" * 8, b"99999999"))
        elif kind == 4:
            start, length = rng.randrange(len(data)), rng.choice((1, 7, 64, 1000))
            del data[start : start + length]
        else:
            start, length = rng.randrange(len(data)), rng.choice((1, 7, 64, 1000))
            data[start:start] = data[start : start + length]
        return bytes(data)

    return harm
