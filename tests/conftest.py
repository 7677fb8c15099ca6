"""Shared by all tests: seeds, threads, and the one place where GPU tests are skipped."""

from __future__ import annotations

import ctypes
import gc
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

# Before torch reads it. Tests are small: a second thread gains little, and spins on a busy machine. Commands that tests
# start inherit this, so their sums are the same as those of this process.
os.environ["OMP_NUM_THREADS"] = "1"

import hypothesis
import pytest
import torch
from filelock import FileLock
from short_prunes import short_distillation, short_prunes  # noqa: F401

from sundae_ns.core.errors import BackendError
from sundae_ns.cuda import kernels
from sundae_ns.cuda.kernels import Argument, Launch

Once = Callable[[str, Callable[[Path], None]], Path]

# Imports leave a million objects. To look for garbage among them as often as usual takes a fifth of the tests' time.
gc.set_threshold(100_000)

ALL_SEEDS = os.environ.get("SUNDAE_ALL_SEEDS") == "1"
_FIRST = ("integration/test_trials.py", "plugin/test_whole_runs.py", "integration", "plugin", "cli")
"""Long files and folders with long files, the longest first. Workers that start with these end together."""

# Definitions that a GPU's compiler has built in, and a setter of the block index. A block has one thread here, so
# memory that threads of a block share is filled before it is read, and a warp of one lane exchanges with itself.
_SHIM = """
#include <math.h>
#define __device__
#define __global__
#define __forceinline__ inline
#define __restrict__
#define __shared__ static
#define __align__(n) __attribute__((aligned(n)))
#define __syncthreads()
#define __syncthreads_count(x) ((x) ? 1 : 0)
#define __any_sync(mask, x) (x)
#define __all_sync(mask, x) (x)
#define __ballot_sync(mask, x) ((x) ? 1u : 0u)
#define __ffs __builtin_ffs
#define __clz __builtin_clz
#define __shfl_xor_sync(mask, x, offset) (x)
#define __expf expf
#define __fdividef(a, b) ((a) / (b))
inline void atomicAdd(float* to, float x) { *to += x; }
inline void atomicMax(int* to, int x) { *to = *to < x ? x : *to; }
inline float rsqrtf(float x) { return 1 / sqrtf(x); }
struct Index { unsigned x; };
static Index blockIdx, blockDim = {1}, threadIdx;
%s
extern "C" void at(unsigned block) { blockIdx.x = block; }
"""


def pytest_configure() -> None:
    # A test on a busy machine may be slow, so examples have no deadline.
    hypothesis.settings.register_profile("few", max_examples=10, deadline=None)
    hypothesis.settings.register_profile("all", max_examples=200, deadline=None)
    hypothesis.settings.register_profile("release", max_examples=5000, deadline=None)
    hypothesis.settings.load_profile("all" if ALL_SEEDS else "few")


def _callers() -> list[SimpleNamespace]:
    """The functions on the stack, innermost first, without their sources."""
    frame, found = sys._getframe(1), []
    while frame is not None:
        found.append(SimpleNamespace(function=frame.f_code.co_name))
        frame = frame.f_back
    return found


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    # nerfstudio calls inspect.stack() 26 times while it is imported, each time for one name. Below pytest this takes
    # 10 s.
    with mock.patch("inspect.stack", _callers):
        return (yield)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent

    def place(item: pytest.Item) -> int:
        name = item.path.relative_to(here)
        return next((number for number, first in enumerate(_FIRST) if name.is_relative_to(first)), len(_FIRST))

    items.sort(key=place)
    gc.freeze()  # what imports left is not looked through again, by pytest at the end neither
    skips = {} if ALL_SEEDS else {"long": "takes a minute or more: make test-all"}
    skips |= {} if torch.cuda.is_available() else {"gpu": "no CUDA device here"}
    for item in items:
        for mark, reason in skips.items():
            if item.get_closest_marker(mark):  # not item.keywords, which has folders of that name too
                item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float32)  # a test that failed may have left another
    if torch.get_num_threads() != 1:  # a script that an earlier test ran in this process chose its own
        torch.set_num_threads(1)


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Make a folder once for all workers of pytest-xdist: the first to ask makes it, the others wait for it."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(name: str, make: Callable[[Path], None]) -> Path:
        folder, done = shared / name, shared / f"{name}.done"
        with FileLock(shared / f"{name}.lock"):
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def compile_for_cpu(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., ctypes.CDLL]:
    """Compile a CUDA source, with compiler options, to a library for the CPU."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ here to compile the kernels for the CPU")
    folder = tmp_path_factory.mktemp("kernels")

    def compile_them(source: str, options: Sequence[str] = ()) -> ctypes.CDLL:
        library = folder / f"{abs(hash((source, *options)))}.so"
        if not library.exists():
            library.with_suffix(".cpp").write_text(_SHIM % source)
            flags = ["-O1", "-w", "-shared", "-fPIC", *options]
            subprocess.run([compiler, *flags, "-o", library, library.with_suffix(".cpp")], check=True)
        return ctypes.CDLL(str(library))

    return compile_them


@pytest.fixture(scope="session")
def load_on_cpu(compile_for_cpu: Callable[..., ctypes.CDLL]) -> Callable[..., dict[str, Launch]]:
    """As ``kernels.load_kernels``, but for the CPU."""

    def compile_them(file: str, names: Sequence[str], options: Sequence[str], *_: object) -> dict[str, Launch]:
        loaded = compile_for_cpu(kernels.read_source(file), options)

        def launch_of(name: str) -> Launch:
            def launch(threads: int, arguments: Sequence[Argument]) -> None:
                values = [kernels._as_c(a, torch.device("cpu")) for a in arguments]
                # More threads than requested, as whole blocks have.
                for block in range(threads + 3):
                    loaded.at(block)
                    getattr(loaded, name)(*values)

            return launch

        return {name: launch_of(name) for name in names}

    return compile_them


@pytest.fixture(scope="session")
def compile_for_gpu() -> Callable[..., bytes]:
    """As ``kernels.compile_cubin``; skip where the compiler is missing."""
    try:
        kernels._library("nvrtc")
    except BackendError as error:
        pytest.skip(f"no NVRTC here: {error}")
    return kernels.compile_cubin
