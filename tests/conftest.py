"""Shared by all tests: seeds, threads, and the one place where GPU tests are skipped."""

from __future__ import annotations

import ctypes
import importlib
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence

import pytest
import torch

from sundae_ns.gpu import nvrtc
from sundae_ns.gpu.nvrtc import Argument, Launch

CompileKernels = Callable[..., dict[str, Launch]]

# What a GPU's compiler knows by itself, and a loop over the threads. A block has one thread here, so that what the threads
# of a block share is filled before it is read.
_SHIM = """
#include <math.h>
#define __device__
#define __global__
#define __forceinline__ inline
#define __restrict__
#define __shared__ static
#define __align__(n) __attribute__((aligned(n)))
#define __syncthreads()
inline float rsqrtf(float x) { return 1 / sqrtf(x); }
struct Index { unsigned x; };
static Index blockIdx, blockDim = {1}, threadIdx;
%s
extern "C" void at(unsigned block) { blockIdx.x = block; }
"""


def pytest_configure() -> None:
    # Tests are small: a second thread gains little, and waits long where something else runs on the machine. Commands
    # that tests start inherit it, so that their sums come out as those of this process.
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if torch.cuda.is_available():
        return
    skip = pytest.mark.skip(reason="no CUDA device here")
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def open3d() -> None:
    """Skips where open3d cannot be imported: it loads libraries of a desktop."""
    try:
        importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d does not import here: {error}")


@pytest.fixture(scope="session")
def compile_for_cpu(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., ctypes.CDLL]:
    """The very lines of CUDA kernels as a library for the CPU: of a source and options of the compiler."""
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
def compile_kernels(compile_for_cpu: Callable[..., ctypes.CDLL]) -> CompileKernels:
    """The same as launches: of a source, names of kernels and options of the compiler."""

    def compile_them(source: str, names: Sequence[str], options: Sequence[str] = ()) -> dict[str, Launch]:
        loaded = compile_for_cpu(source, options)

        def launch_of(name: str) -> Launch:
            def launch(threads: int, arguments: Sequence[Argument]) -> None:
                values = [nvrtc._as_c(a, torch.device("cpu")) for a in arguments]
                # More threads than asked for, as whole blocks have.
                for block in range(threads + 3):
                    loaded.at(block)
                    getattr(loaded, name)(*values)

            return launch

        return {name: launch_of(name) for name in names}

    return compile_them
