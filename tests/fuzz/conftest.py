"""Bad input: a reader either succeeds or fails with a one-line error, quickly and in little memory.

Each kind of input has one file ``test_<kind>.py``. It takes a valid input made by the package, corrupts it with
``corrupted`` or by hand, and judges each case with ``verdict``. A generator is marked ``seeds(n)``: it runs ten of its
n seeds, or all of them if the environment variable ``SUNDAE_ALL_SEEDS`` is 1. Cases written by hand always run.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest
from colmap_models import write_model
from small_captures import HEIGHT, SIZE, VIEWS, WIDTH

from harness.still_life import write_still_life
from sundae_ns.core.errors import SundaeError

FEW_SEEDS = 10
"""Seeds of each generator in a normal run."""
SECONDS = 30
"""Time limit of one case; cases take milliseconds, so only a hang reaches it."""
BASE, FACTOR = 24 << 20, 40
"""Memory limit of one case: BASE bytes plus FACTOR bytes per byte of input."""


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "seeds(n): parametrize `seed`; ten seeds, or n if SUNDAE_ALL_SEEDS is 1")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrize ``seed`` of tests marked ``seeds(n)``."""
    marker = metafunc.definition.get_closest_marker("seeds")
    if marker is not None:
        (count,) = marker.args
        metafunc.parametrize("seed", seeds(count))


def seeds(count: int) -> range:
    """The seeds of a generator that has ``count`` of them."""
    return range(count if os.environ.get("SUNDAE_ALL_SEEDS") == "1" else min(count, FEW_SEEDS))


class Hang(BaseException):
    """Raised by the alarm; a ``BaseException``, so that no reader catches it as an error of its input."""


@pytest.fixture
def verdict() -> Callable[..., SundaeError | None]:
    """Call a reader under limits of time and memory; return None on success, or the ``SundaeError`` that it raised."""

    def stop(*_: Any) -> None:
        raise Hang

    def judge(reader: Callable[[], Any], size: int) -> SundaeError | None:
        capacity = BASE + FACTOR * size
        before = signal.signal(signal.SIGALRM, stop)
        limits = resource.getrlimit(resource.RLIMIT_AS)
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        error: SundaeError | None = None
        signal.alarm(SECONDS)
        tracemalloc.start()
        try:
            # tracemalloc counts Python and numpy; the limit on addresses covers all others, such as torch.
            resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (256 << 20) + capacity, limits[1]))
            reader()
        except SundaeError as raised:
            error = raised
        finally:
            signal.alarm(0)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            resource.setrlimit(resource.RLIMIT_AS, limits)
            signal.signal(signal.SIGALRM, before)
        assert peak <= capacity, f"took {peak:,} bytes of memory for {size:,} bytes of input"
        if error is not None:
            assert "\n" not in str(error)
            assert 10 < len(str(error)) < 600
            causes = [error.__cause__, error.__context__]
            assert not any(isinstance(cause, MemoryError) or "allocate memory" in str(cause) for cause in causes)
        return error

    return judge


@pytest.fixture(scope="session")
def corrupted() -> Callable[[bytes, int], bytes]:
    """Corrupt the bytes of a file; the seed chooses: truncate, flip bits, replace bytes, delete or repeat a part."""

    def corrupt(content: bytes, seed: int) -> bytes:
        rng = Random(seed)
        data = bytearray(content)
        kind = seed % 6
        if kind == 0:
            return bytes(data[: rng.randrange(len(data))])
        if kind == 1:
            for _ in range(rng.choice((1, 3, 30))):
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        elif kind == 2:  # in the first bytes, which hold counts and types
            for _ in range(rng.choice((1, 4))):
                data[rng.randrange(min(len(data), 80))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        elif kind == 3:  # the largest values of counts, lengths and numbers
            start = rng.randrange(len(data))
            data[start : start + 8] = rng.choice((b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\x00" * 8, b"99999999"))
        elif kind == 4:
            start, length = rng.randrange(len(data)), rng.choice((1, 7, 64, 1000))
            del data[start : start + length]
        else:
            start, length = rng.randrange(len(data)), rng.choice((1, 7, 64, 1000))
            data[start:start] = data[start : start + length]
        return bytes(data)

    return corrupt


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture with a transforms.json; tests change a copy."""
    out = tmp_path_factory.mktemp("capture") / "scene"
    return write_still_life(out, train_views=VIEWS, test_views=1, width=WIDTH, height=HEIGHT, points=40, samples=1)


@pytest.fixture
def capture(scene: Path, tmp_path: Path) -> Path:
    """A copy of the capture for one test, with a transforms.json and a COLMAP model."""
    copy = Path(shutil.copytree(scene, tmp_path / "scene"))
    write_model(copy / "sparse" / "0", sorted(path.name for path in (copy / "images").iterdir()), SIZE)
    return copy
