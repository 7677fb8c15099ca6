"""Wall-clock times that include the device's work, and peak memory."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from statistics import median

import torch


def now(device: torch.device | str) -> float:
    """Seconds on the host's wall clock, after the device has finished its queued work; only differences count."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def median_ms(fn: Callable[[], object], *, device: torch.device | str, warmup: int = 5, repeats: int = 20) -> float:
    """Median milliseconds of ``repeats`` calls of a function, until the device is idle again, after ``warmup`` ones."""
    for _ in range(warmup):
        fn()
    times = []
    for _ in range(repeats):
        start = now(device)
        fn()
        times.append(1e3 * (now(device) - start))
    return median(times)


def peak_memory(device: torch.device) -> int:
    """Peak memory so far in bytes: allocated by torch on a CUDA device, else resident on the host; 0 if unknown."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    try:
        import resource
    except ImportError:  # not on Windows
        return 0
    # Linux reports kibibytes, macOS bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
