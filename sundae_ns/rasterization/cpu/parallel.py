"""Compiled loops, and threads that share them.

Loops are compiled without the interpreter's lock, and ordinary threads share them. Numba has thread pools of its own, but
on its OpenMP pool a process that forks dies (data loaders do), its built-in pool dies when two threads use it at once
(a viewer does), and ``parallel=True`` takes several times as long to compile.

A loop writes what belongs to its own range and nothing else, so what comes out does not depend on the threads.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

_SHARES = 8  # of each thread: enough for an even load, few enough that handing them out costs nothing
_PATIENCE = 1.0  # seconds that a loop may compile before a line says so; reading it from disk takes milliseconds

_SOURCES = "".join(path.read_text() for path in sorted(Path(__file__).parent.glob("*.py")))
"""Of this package: loops call functions of its other modules, and numba looks only at the file of a loop itself."""

_ready: set[tuple[Any, ...]] = set()  # loops that were called, and the types that they were called with


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile at the first call for its types; later processes read the machine code from disk.

    numba keeps it beside the module, or in the user's cache folder, and compiles anew when this package's files change.
    """
    return _compile(function)


def compiled_into(function: Callable[..., Any]) -> Callable[..., Any]:
    """As :func:`compiled`, for a piece of a loop: it becomes part of its callers, in which lanes then stay in registers."""
    return _compile(function, forceinline=True)


def _compile(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    # x / 0 is what it is in torch: raising would cost a branch.
    options |= {"nogil": True, "error_model": "numpy"}
    # Constants are compiled in, and may come from other modules: part of the name, they choose the file.
    numbers = sorted((k, v) for k, v in function.__globals__.items() if isinstance(v, (int, float)))
    function.__qualname__ += "_" + hashlib.sha256(f"{numbers} {_SOURCES}".encode()).hexdigest()[:8]
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # neither the package's folder nor the user's can be written to
        return njit(**options)(function)


def share(loop: Callable[..., None], count: int, *arguments: Any, at_least: int = 1) -> None:
    """Run ``loop(begin, end, *arguments)`` over ``range(count)`` in ranges, on as many threads as torch uses.

    Args:
        loop: from :func:`compiled`.
        count: iterations in all.
        arguments: of the loop.
        at_least: iterations that are worth a thread.
    """
    types = (loop, *(argument.dtype for argument in arguments if isinstance(argument, np.ndarray)))
    if types not in _ready:
        _compile_now(loop, arguments)
        _ready.add(types)
    threads = min(torch.get_num_threads(), -(-count // at_least))
    if threads <= 1:
        loop(0, count, *arguments)
        return
    size = -(-count // (threads * _SHARES))
    begins = iter(range(0, count, size))  # whoever is free takes the next range

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


def _compile_now(loop: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    """Here and not in the pool, whose threads may have too small a stack for a compiler."""
    notice = Timer(_PATIENCE, _say_that_it_compiles)
    notice.daemon = True
    notice.start()
    try:
        loop(0, 0, *arguments)
    finally:
        notice.cancel()


@lru_cache(maxsize=1)
def _say_that_it_compiles() -> None:
    """Once in a process, however many loops there are."""
    print(
        "sundae: compiling the CPU rasteriser, some ten seconds, once for each precision", file=sys.stderr, flush=True
    )


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="sundae-rasterizer")


# Threads do not survive a fork: a child that rasterises makes its own.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


def as_array(tensor: Tensor) -> Any:
    """The memory of a tensor as a C-contiguous numpy array; another layout would be compiled anew.

    numpy makes the copy, where there has to be one: after torch's, its threads keep waiting on the cores that ours need.
    """
    return np.ascontiguousarray(tensor.detach().numpy())
