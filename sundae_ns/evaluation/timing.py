"""Times that wait for the device to finish."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from sundae_ns.errors import ConfigError


@dataclass(frozen=True)
class Timing:
    """Wall-clock times of repeated calls, milliseconds."""

    median_ms: float
    min_ms: float
    p90_ms: float
    """Nine calls in ten are at most this slow."""
    repeats: int


def now(device: torch.device | str) -> float:
    """Seconds by the host's wall clock, from any start, read once the device has done what was asked of it."""
    device = torch.device(device)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()
    return time.perf_counter()


def median_ms(fn: Callable[[], object], *, device: torch.device | str, warmup: int = 5, repeats: int = 20) -> Timing:
    """Time a function from its call until the device is idle again.

    The wall clock is read on the host, on both sides of a synchronisation, so that the cost of launching the work
    counts as it does for whoever waits for a picture.

    Args:
        fn: called without arguments; its result is dropped.
        device: where it works.
        warmup: untimed calls before.
        repeats: timed calls.

    Raises:
        ConfigError: ``warmup`` is negative, or ``repeats`` less than 1.
    """
    if warmup < 0 or repeats < 1:
        raise ConfigError(f"{warmup} warm-up calls and {repeats} timed ones; give at least 0 and 1.")
    for _ in range(warmup):
        fn()
    times = []
    for _ in range(repeats):
        start = now(device)
        fn()
        times.append(1e3 * (now(device) - start))
    return Timing(float(np.median(times)), min(times), float(np.quantile(times, 0.9, method="higher")), repeats)
