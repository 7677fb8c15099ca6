"""Morton (Z-order) codes of positions: the interleaved bits of three coordinates (Morton, 1966)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MAX_BITS = 21
"""Maximum number of bits per coordinate; three fit in 64 bits."""

_SPREADS = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def interleave(cells: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Codes ``[N]`` of cells ``[N, 3]`` with coordinates below 2^21; the first coordinate takes the lowest bit."""
    code = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        x = cells[:, axis].astype(np.uint64)
        for shift, mask in _SPREADS:
            x = (x | (x << np.uint64(shift))) & np.uint64(mask)
        code |= x << np.uint64(axis)
    return code


def separate(codes: NDArray[np.uint64], axis: int) -> NDArray[np.uint64]:
    """One coordinate ``[N]`` of the cells of codes ``[N]``."""
    x = codes >> np.uint64(axis)
    x &= np.uint64(_SPREADS[-1][1])
    masks = [mask for _, mask in _SPREADS[-2::-1]] + [(1 << MAX_BITS) - 1]
    for (shift, _), mask in zip(_SPREADS[::-1], masks, strict=True):
        x |= x >> np.uint64(shift)
        x &= np.uint64(mask)
    return x


def scene_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Permutation ``[N]`` that sorts finite centres ``[N, 3]`` along a space-filling curve.

    Coordinates are centred on their medians and compressed by an inverse hyperbolic sine, so that a few far primitives
    do not push all others into one cell.
    """
    centred = means.astype(np.float64) - np.median(means, axis=0)
    spread = np.median(np.abs(centred))
    if spread == 0:
        spread = np.abs(centred).mean() or 1.0
    bent = np.arcsinh(centred / spread)
    low, extent = bent.min(axis=0), np.ptp(bent, axis=0).max() or 1.0
    cells = ((bent - low) / extent * (2**MAX_BITS - 1)).astype(np.uint64)
    return np.argsort(interleave(cells), kind="stable")
