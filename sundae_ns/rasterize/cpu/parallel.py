"""Compiled loops, and the threads that run them.

Loops run on ordinary threads without the interpreter's lock. With numba's OpenMP pool a forked process dies, such as a
data loader; with its built-in pool two callers at once die, such as a viewer; ``parallel=True`` compiles far longer.

A loop writes only the elements of its own range, so results do not depend on the number of threads.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache, partial
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

_RANGES_PER_THREAD = 8  # enough for an even load, few enough to cost nothing
_NOTICE_AFTER = 1.0  # seconds of compilation before a notice is printed

# Sources of all functions that loops call.
_FILES = (*sorted(Path(__file__).parent.glob("*.py")), Path(__file__).parents[1] / "reference.py")
_SOURCES = "".join(path.read_text(encoding="utf-8") for path in _FILES)

_ready: set[tuple[Any, ...]] = set()  # loops already called, with the dtypes of their arguments
_noticed: list[Any] = []  # the loop whose compilation was announced: once for each process


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Compile at the first call with new types; later processes load the machine code from disk.

    numba caches it beside the module or in the user's cache folder, and recompiles when a file of this package changes.
    """
    # x / 0 gives inf or NaN, as in torch: raising would cost a branch.
    options |= {"nogil": True, "error_model": "numpy"}
    # numba's cache follows the function's own file only. But constants and functions of other modules are compiled in
    # too: their hash becomes part of the function's name, so that a change selects another cache file.
    numbers = sorted((k, v) for k, v in function.__globals__.items() if isinstance(v, (int, float)))
    function.__qualname__ += "_" + hashlib.sha256(f"{numbers} {_SOURCES}".encode()).hexdigest()[:8]
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # neither the package's folder nor the user's is writable
        return njit(**options)(function)


borrowing = partial(compiled, _nrt=False)
"""As :func:`compiled`, for loops that make no arrays: they do not count who uses those that they are given."""
inlined = partial(borrowing, forceinline=True)
"""As :data:`borrowing`, for functions that are inlined into the calling loop, which keeps lanes in registers."""


def parallel_for(loop: Callable[..., None], count: int, *arguments: Any, min_per_thread: int = 1) -> None:
    """Run ``loop(begin, end, *arguments)`` on ranges that cover ``range(count)``, on as many threads as torch uses.

    ``loop`` is from :func:`compiled`; ``min_per_thread`` are the fewest iterations that are worth another thread.
    """
    types = (loop, *(argument.dtype for argument in arguments if isinstance(argument, np.ndarray)))
    if types not in _ready:
        notice = Timer(_NOTICE_AFTER, _print_notice, [loop])
        notice.daemon = True
        notice.start()
        try:
            loop(0, 0, *arguments)  # compile on this thread: the stacks of the pool may be too small
        finally:
            notice.cancel()
        _ready.add(types)
    threads = min(torch.get_num_threads(), -(-count // min_per_thread))
    if threads <= 1:
        loop(0, count, *arguments)
        return
    size = -(-count // (threads * _RANGES_PER_THREAD))
    begins = iter(range(0, count, size))  # an idle thread takes the next range

    def work() -> None:
        for begin in begins:
            loop(begin, min(begin + size, count), *arguments)

    helpers = [_pool().submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        wait(helpers)
    for helper in helpers:
        helper.result()


def _print_notice(loop: Any) -> None:
    if loop.stats.cache_misses and not _noticed:  # reading code from disk is slow too on a busy machine
        _noticed.append(loop)
        each = "precision" if loop.stats.cache_path else "command; set NUMBA_CACHE_DIR to a folder that can be written"
        print(f"sundae: compiling the CPU rasteriser, some ten seconds, once for each {each}", file=sys.stderr)


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="sundae-rasterizer")


if hasattr(os, "register_at_fork"):  # threads do not survive a fork: a child process makes its own pool
    os.register_at_fork(after_in_child=_pool.cache_clear)


def as_array(tensor: Tensor) -> Any:
    """A tensor as a C-contiguous numpy array, because each other layout would be compiled anew."""
    # numpy makes the copy: after a copy by torch, its threads spin on the cores that these loops need.
    return np.ascontiguousarray(tensor.detach().numpy())
