"""Values that are hard to quantise, for the tests of packing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

KINDS = ("normal", "constant", "huge", "tiny", "outliers", "two values", "far from zero")


def hard_values(kind: str, n: int, width: int, seed: int) -> NDArray[np.float32]:
    """Random values ``[n, width]`` of one of :data:`KINDS`."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, width))
    if kind == "constant":
        x[:] = 0.3
    elif kind == "huge":
        x *= 1e6
    elif kind == "tiny":
        x *= 1e-30
    elif kind == "outliers":
        x[rng.random((n, width)) < 0.002] *= 1e6
    elif kind == "two values":
        x = np.where(x > 1, 1e4, -1e-4)
    elif kind == "far from zero":
        x += 1e6
    return x.astype(np.float32)


def drifted(x: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
    """Values after training: moved, and some out of range."""
    rng = np.random.default_rng(seed + 1)
    moved = x + 0.05 * x.std() * rng.normal(size=x.shape)
    moved[rng.random(len(x)) < 0.01] *= 3
    return moved.astype(np.float32)
