"""Numbers in few bits: ranges that outliers cannot ruin, positions in blocks, smallest-three rotations, network weights.

Each pair of functions states its error bound. Bounds leave out the rounding to float32 of what is returned, at most half a
unit in its last place. What rounds is written once, in torch: files are made of ``levels``, and training with rounding in the
loop sees ``rounded`` of the same.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.storage.packing.morton import interleave, separate

Floats = NDArray[np.float32]
Codes = NDArray[Any]

TAIL = 0.001
"""Share of the values of a channel at either end that may lie outside of its range and are then stored as they are."""
_ROOT_HALF = 0.5**0.5


def code_type(bits: int) -> type[np.unsignedinteger[Any]]:
    """Smallest unsigned integer with this many bits, at most 16."""
    return np.uint8 if bits <= 8 else np.uint16


class Grid(NamedTuple):
    """Even levels of each channel; see :func:`fit_grid`."""

    low: Tensor
    """Value of code 0, float64 ``[C]``."""
    high: Tensor
    """Value of the last code; what lies beyond either is kept exactly. float64 ``[C]``."""
    step: Tensor
    """Distance of neighbouring levels, 0 where a channel is constant, float64 ``[C]``."""
    bits: int


def fit_grid(values: Floats, bits: int, *, shared: bool = False) -> Grid:
    """Levels for values like these; the outermost :data:`TAIL` at either end is left out where it is far off.

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
    ends = (np.where(worth, low, least), np.where(worth, high, most))
    low, high = (torch.from_numpy(np.broadcast_to(end, len(columns)).copy()) for end in ends)
    return Grid(low, high, (high - low) / (2**bits - 1), bits)


def levels(values: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """Nearest levels of values ``[N, C]`` as float64 ``[N, C]``, and which lie outside of the range ``[N, C]``."""
    exact = values.double()
    safe = torch.where(grid.step > 0, grid.step, 1.0)
    outside = (exact < grid.low) | (exact > grid.high)
    return ((exact - grid.low) / safe).round().clamp(0, 2**grid.bits - 1), outside


def at_levels(levels: Tensor, low: Tensor, step: Tensor) -> Tensor:
    """Values of levels, float32; all arguments are float64 and broadcast."""
    return (low + levels * step).float()


def rounded(values: Tensor, grid: Grid) -> Tensor:
    """What :func:`dequantize` makes of :func:`quantize`: float32 ``[N, C]``; to the bit on a CPU."""
    found, outside = levels(values, grid)
    return torch.where(outside, values, at_levels(found, grid.low, grid.step))


class Uniform(NamedTuple):
    """Values ``[N, C]`` on a grid; |error| is at most half of the channel's ``step``."""

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


def quantize(values: Floats, grid: Grid) -> Uniform:
    """Round values ``[N, C]``, finite, to the levels of a grid; those outside of its range are kept exactly."""
    found, outside = levels(torch.from_numpy(values), grid)
    codes = found.T.numpy().astype(code_type(grid.bits), order="C")
    places = np.flatnonzero(outside.T.numpy()).astype(np.uint32)
    exceptions = np.ascontiguousarray(values.T).reshape(-1)[places]
    return Uniform(codes, grid.low.numpy(), grid.step.numpy(), places, exceptions)


def dequantize(packed: Uniform) -> Floats:
    """Counterpart of :func:`quantize`: ``[N, C]``."""
    channels, n = packed.codes.shape
    every = torch.arange(int(np.iinfo(packed.codes.dtype).max) + 1, dtype=torch.float64)
    tables = at_levels(every, *(torch.from_numpy(ends)[:, None] for ends in (packed.low, packed.step))).numpy()
    out = np.empty((n, channels), np.float32)
    for c in range(channels):
        out[:, c] = tables[c][packed.codes[c]]
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


def rotation_levels(quats: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Nearest levels of the three smallest components, float64 ``[3, N]``, and which of wxyz is left out ``[N]``.

    Args:
        quats: wxyz ``[N, 4]``, finite, any length; one of length zero counts as no rotation, as rasterisers show it.
        bits: a component, 4 to 16.
    """
    q = quats.double()
    scale = q.abs().amax(dim=1, keepdim=True)
    q = torch.where(scale > 0, q / torch.where(scale > 0, scale, 1.0), q.new_tensor([1.0, 0.0, 0.0, 0.0]))
    largest = q.abs().argmax(dim=1)
    # Sums are written out, so that they do not depend on the number of rows.
    w, x, y, z = q.T
    length = (w * w + x * x + y * y + z * z).sqrt()
    sign = torch.where(q.gather(1, largest[:, None])[:, 0] < 0, -1.0, 1.0)
    w, x, y, z = (component / length * sign for component in (w, x, y, z))
    three = torch.stack(
        [torch.where(largest <= i, after, before) for i, (before, after) in enumerate(((w, x), (x, y), (y, z)))]
    )
    found = ((three / _ROOT_HALF + 1) / 2 * (2**bits - 1)).round()
    return found.clamp(0, 2**bits - 1), largest


def _component(levels: Tensor, bits: int) -> Tensor:
    """Components of unit quaternions at levels (float64), float32."""
    return ((levels * 2 / (2**bits - 1) - 1) * _ROOT_HALF).float()


def _unit(three: Tensor, largest: Tensor) -> Tensor:
    """Unit quaternions wxyz ``[N, 4]``, the largest component positive, of the others ``[3, N]``, float32."""
    a, b, c = three
    fourth = (1 - (a * a + b * b + c * c)).clamp_min(0).sqrt()
    places = []
    for i in range(4):
        other = torch.where(largest < i, three[max(i - 1, 0)], three[min(i, 2)])
        places.append(torch.where(largest == i, fourth, other))
    w, x, y, z = places
    length = (w * w + x * x + y * y + z * z).sqrt().clamp_min(torch.finfo(torch.float32).tiny)
    return torch.stack([place / length for place in places], dim=1)


def rounded_rotations(quats: Tensor, bits: int) -> Tensor:
    """What :func:`dequantize_rotations` makes of :func:`quantize_rotations`: ``[N, 4]``; to the bit on a CPU."""
    found, largest = rotation_levels(quats, bits)
    return _unit(_component(found, bits), largest)


def quantize_rotations(quats: Floats, bits: int) -> Rotations:
    """Keep the three smallest components of each quaternion, whose sign is free; arguments as :func:`rotation_levels`."""
    found, largest = rotation_levels(torch.from_numpy(quats), bits)
    return Rotations(found.numpy().astype(code_type(bits)), largest.numpy().astype(np.uint8))


def dequantize_rotations(packed: Rotations, bits: int) -> Floats:
    """Counterpart of :func:`quantize_rotations`: unit quaternions wxyz ``[N, 4]``, the largest component positive."""
    every = torch.arange(int(np.iinfo(packed.codes.dtype).max) + 1, dtype=torch.float64)
    three = _component(every, bits).numpy()[packed.codes]
    out: Floats = _unit(torch.from_numpy(three), torch.from_numpy(packed.largest)).numpy()
    return out


def weight_steps(weight: Tensor, bits: int) -> Tensor:
    """A step for each output channel of weights ``[O, ...]``, the largest within 2^(bits - 1) - 1 of it: float32 ``[O]``."""
    step = weight.reshape(len(weight), -1).double().abs().amax(dim=1) / (2 ** (bits - 1) - 1)
    stored = step.float()
    # Rounded up, so that the largest weight does not end one step short.
    return torch.where(step > 0, torch.nextafter(stored, torch.full_like(stored, torch.inf)), 0.0)


def weight_levels(weight: Tensor, step: Tensor, bits: int) -> Tensor:
    """Nearest levels of weights ``[O, ...]``, float64."""
    wide = step.reshape(-1, *([1] * (weight.ndim - 1))).double()
    most = 2 ** (bits - 1) - 1
    return (weight.double() / torch.where(wide > 0, wide, 1.0)).round().clamp(-most, most)


def weights_at(levels: Tensor, step: Tensor) -> Tensor:
    """Weights at levels ``[O, ...]``, float32."""
    return levels.float() * step.reshape(-1, *([1] * (levels.ndim - 1)))


def rounded_weights(weight: Tensor, step: Tensor, bits: int) -> Tensor:
    """What :func:`dequantize_weights` makes of :func:`quantize_weights`: ``[O, ...]``; to the bit on a CPU."""
    return weights_at(weight_levels(weight, step, bits), step)


def quantize_weights(weight: Floats, step: Floats, bits: int = 8) -> NDArray[np.int8]:
    """Round weights ``[O, ...]``, finite; |error| is at most half of the channel's step where :func:`weight_steps` made it.

    Args:
        weight: ``[O, ...]``, finite.
        step: of each output channel ``[O]``.
        bits: 2 to 8.

    Returns:
        Codes ``[O, ...]``.
    """
    codes: NDArray[np.int8] = (
        weight_levels(torch.from_numpy(weight), torch.from_numpy(step), bits).to(torch.int8).numpy()
    )
    return codes


def dequantize_weights(codes: NDArray[np.int8], step: Floats) -> Floats:
    """Counterpart of :func:`quantize_weights`."""
    out: Floats = weights_at(torch.from_numpy(codes.astype(np.float32)), torch.from_numpy(step.copy())).numpy()
    return out
