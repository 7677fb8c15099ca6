"""Numbers in few bits: ranges that outliers cannot ruin, positions in blocks, smallest-three rotations, network weights.

Each pair of functions states its error bound. Bounds leave out the rounding to float32 of what is returned, at most half a
unit in its last place.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sundae_ns.storage.packing.morton import interleave, separate

Floats = NDArray[np.float32]
Codes = NDArray[Any]

TAIL = 0.001
"""Share of the values of a channel at either end that may lie outside of its range and are then stored as they are."""
_ROOT_HALF = 0.5**0.5


def code_type(bits: int) -> type[np.unsignedinteger[Any]]:
    """Smallest unsigned integer with this many bits, at most 16."""
    return np.uint8 if bits <= 8 else np.uint16


class Uniform(NamedTuple):
    """Values ``[N, C]`` on an even grid a channel; |error| is at most half of the channel's ``step``."""

    codes: Codes
    """``[C, N]`` unsigned."""
    low: NDArray[np.float64]
    """Value of code 0 ``[C]``."""
    step: NDArray[np.float64]
    """Distance of neighbouring codes ``[C]``."""
    places: NDArray[np.uint32]
    """Places of the exceptions in the flattened ``[C, N]``, rising ``[E]``."""
    exceptions: Floats
    """Their values, exact ``[E]``."""


def quantize(values: Floats, bits: int, *, shared: bool = False) -> Uniform:
    """Round to ``2^bits`` levels a channel; the outermost :data:`TAIL` at either end is kept exactly where it is far off.

    Args:
        values: ``[N, C]``, finite, N at least 1.
        bits: 1 to 16.
        shared: give all channels one range.
    """
    columns = values.T.astype(np.float64)
    rows = columns.reshape(1, -1) if shared else columns
    least, most = rows.min(axis=1), rows.max(axis=1)
    low, high = np.quantile(rows, [TAIL, 1 - TAIL], axis=1, method="nearest")
    # An end is only cut off where that makes the step a quarter finer; else it costs more than it gains.
    worth = 1.25 * (high - low) < most - least
    low, high = np.where(worth, low, least), np.where(worth, high, most)
    low, high = (np.broadcast_to(end, len(columns)).copy() for end in (low, high))
    step = (high - low) / (2**bits - 1)
    safe = np.where(step > 0, step, 1.0)[:, None]
    levels = np.rint((columns - low[:, None]) / safe)
    outside = (columns < low[:, None]) | (columns > high[:, None])
    places = np.flatnonzero(outside).astype(np.uint32)
    codes = np.clip(levels, 0, 2**bits - 1).astype(code_type(bits))
    return Uniform(codes, low, step, places, np.ascontiguousarray(values.T).reshape(-1)[places])


def dequantize(packed: Uniform) -> Floats:
    """Counterpart of :func:`quantize`: ``[N, C]``."""
    channels, n = packed.codes.shape
    out = np.empty((n, channels), np.float32)
    for c in range(channels):
        levels = np.arange(int(np.iinfo(packed.codes.dtype).max) + 1)
        table = (packed.low[c] + levels * packed.step[c]).astype(np.float32)
        out[:, c] = table[packed.codes[c]]
    column, row = np.divmod(packed.places.astype(np.int64), max(n, 1))
    out[row, column] = packed.exceptions
    return out


class Blocks(NamedTuple):
    """Positions in blocks of neighbours; |error| is at most half of (high - low) / (2^bits - 1) of the block and axis."""

    deltas: NDArray[np.uint64]
    """Differences of the Morton codes of a block, rising within it; a block's first stands for itself ``[N]``."""
    low: Floats
    """Lower bounds of the blocks ``[B, 3]``."""
    high: Floats
    """Upper bounds ``[B, 3]``."""


def quantize_positions(means: Floats, bits: int, size: int) -> tuple[Blocks, NDArray[np.int64]]:
    """Round positions to a grid in each block, and sort each block along it, which drops the cost of the order.

    Args:
        means: ``[N, 3]``, finite, neighbours near each other (``morton.scene_order``).
        bits: a coordinate, 1 to 21.
        size: primitives a block.

    Returns:
        The blocks, and the order ``[N]`` in which they hold the rows of ``means``.
    """
    n = len(means)
    starts = np.arange(0, n, size)
    low, high = np.minimum.reduceat(means, starts), np.maximum.reduceat(means, starts)
    block = np.arange(n) // size
    extent = high.astype(np.float64) - low
    extent[extent == 0] = 1.0
    cells = np.rint((means.astype(np.float64) - low[block]) / extent[block] * (2**bits - 1)).astype(np.uint64)
    codes = interleave(cells)
    order = np.lexsort((codes, block))
    codes = codes[order]
    deltas = np.diff(codes, prepend=np.uint64(0))
    deltas[starts] = codes[starts]
    return Blocks(deltas, low, high), order


def dequantize_positions(packed: Blocks, bits: int, size: int) -> Floats:
    """Counterpart of :func:`quantize_positions`, in the blocks' order: ``[N, 3]``."""
    n, count = len(packed.deltas), len(packed.low)
    padded = np.zeros(count * size, np.uint64)
    padded[:n] = packed.deltas
    codes = np.cumsum(padded.reshape(count, size), axis=1, dtype=np.uint64).reshape(-1)[:n]
    step = (packed.high.astype(np.float64) - packed.low) / (2**bits - 1)
    out = np.empty((n, 3), np.float32)
    for axis in range(3):
        cells = np.zeros(count * size, np.float64)
        cells[:n] = separate(codes, axis)
        table = cells.reshape(count, size)
        table *= step[:, axis, None]
        table += packed.low[:, axis, None]
        out[:, axis] = cells[:n]
    return out


class Rotations(NamedTuple):
    """Unit quaternions by their three smallest components; see :func:`rotation_bound`."""

    codes: Codes
    """``[3, N]`` unsigned: the others in the order wxyz."""
    largest: NDArray[np.uint8]
    """Which of wxyz is left out ``[N]``."""


def rotation_bound(bits: int) -> float:
    """Most that the angle of a rotation is off, radians.

    Each of three components is off by at most e = sqrt(1/2) / (2^bits - 1), so their vector v by sqrt(3) e. On the sphere
    of unit quaternions, where the fourth component is w = sqrt(1 - |v|^2), a step of v is stretched by at most 1 / w. The
    largest component of four is at least 1/2, so |v| is at most sqrt(3)/2 before rounding. The angle of a rotation is twice
    the angle on that sphere.
    """
    off = 3**0.5 * _ROOT_HALF / (2**bits - 1)
    return 2 * off / (1 - (3**0.5 / 2 + off) ** 2) ** 0.5


def quantize_rotations(quats: Floats, bits: int) -> Rotations:
    """Keep the three smallest components of each quaternion, whose sign is free.

    Args:
        quats: wxyz ``[N, 4]``, finite, any length; one of length zero counts as no rotation, as rasterisers show it.
        bits: a component, 4 to 16.
    """
    q = quats.astype(np.float64)
    scale = np.abs(q).max(axis=1, keepdims=True)
    q = np.where(scale > 0, q / np.where(scale > 0, scale, 1.0), [1.0, 0.0, 0.0, 0.0])
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    largest = np.abs(q).argmax(axis=1)
    rows = np.arange(len(q))
    q *= np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.arange(4)[None] != largest[:, None]
    three = q[others].reshape(-1, 3)
    codes = np.rint((three / _ROOT_HALF + 1) / 2 * (2**bits - 1)).clip(0, 2**bits - 1)
    return Rotations(np.ascontiguousarray(codes.T).astype(code_type(bits)), largest.astype(np.uint8))


def dequantize_rotations(packed: Rotations, bits: int) -> Floats:
    """Counterpart of :func:`quantize_rotations`: unit quaternions wxyz ``[N, 4]``, the largest component positive."""
    levels = np.arange(int(np.iinfo(packed.codes.dtype).max) + 1)
    table = ((levels * 2 / (2**bits - 1) - 1) * _ROOT_HALF).astype(np.float32)
    three = table[packed.codes]
    fourth = np.sqrt(np.maximum(1 - (three * three).sum(axis=0), 0))
    out = np.empty((len(fourth), 4), np.float32)
    for component in range(4):
        place = np.where(packed.largest < component, three[max(component - 1, 0)], three[min(component, 2)])
        out[:, component] = np.where(packed.largest == component, fourth, place)
    norm = np.sqrt((out * out).sum(axis=1, keepdims=True))
    out /= np.maximum(norm, np.finfo(np.float32).tiny)
    return out


def quantize_weights(weight: Floats) -> tuple[NDArray[np.int8], Floats]:
    """Round weights to int8 with one step for each output channel; |error| is at most half of the channel's step.

    Args:
        weight: ``[O, ...]``, finite.

    Returns:
        Codes ``[O, ...]`` and steps ``[O]``.
    """
    flat = weight.reshape(len(weight), -1).astype(np.float64)
    step = np.abs(flat).max(axis=1, initial=0.0) / 127
    # A step is rounded up, so that the largest weight is still within 127 of them.
    stored = np.nextafter(
        step.astype(np.float32), np.float32(np.inf), where=step > 0, out=np.zeros(len(step), np.float32)
    )
    codes = np.rint(flat / np.where(stored > 0, stored, 1.0).astype(np.float64)[:, None])
    return codes.astype(np.int8).reshape(weight.shape), stored


def dequantize_weights(codes: NDArray[np.int8], step: Floats) -> Floats:
    """Counterpart of :func:`quantize_weights`."""
    return codes.astype(np.float32) * step.reshape(-1, *([1] * (codes.ndim - 1)))
