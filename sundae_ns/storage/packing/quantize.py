"""Quantisation: ranges robust to outliers, positions in blocks, rotations by three components, weights of the head.

Each pair of functions states its error bound, without the rounding of the result to float32 (half a unit in the last
place). Rounding is implemented once, in torch: files store ``levels``, and training with rounding uses ``rounded`` of
the same.
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
"""Fraction of the values of a channel at either end that may lie outside of its range; they are stored exactly."""
_ROOT_HALF = 0.5**0.5


def code_type(bits: int) -> type[np.unsignedinteger[Any]]:
    """Smallest unsigned integer type with at least ``bits`` bits, at most 16."""
    return np.uint8 if bits <= 8 else np.uint16


class Grid(NamedTuple):
    """Even levels of each channel; see :func:`fit_grid`."""

    low: Tensor
    """Value of code 0, float64 ``[C]``."""
    high: Tensor
    """Value of the last code, float64 ``[C]``; values outside of [low, high] are stored exactly."""
    step: Tensor
    """Distance between neighbouring levels, 0 for a constant channel, float64 ``[C]``."""
    bits: int


def fit_grid(values: Floats, bits: int, *, shared: bool = False) -> Grid:
    """Fit levels to values; the outermost :data:`TAIL` at either end is excluded if it is far from the others.

    Args:
        values: ``[N, C]``, finite, N at least 1.
        bits: 1 to 16.
        shared: use one range for all channels.
    """
    columns = values.T.astype(np.float64)
    rows = columns.reshape(1, -1) if shared else columns
    smallest, largest = rows.min(axis=1), rows.max(axis=1)
    low, high = np.quantile(rows, [TAIL, 1 - TAIL], axis=1, method="nearest")
    # Exclude the tails only if that makes the step a quarter finer; else the exceptions cost more than they save.
    excluded = 1.25 * (high - low) < largest - smallest
    ends = (np.where(excluded, low, smallest), np.where(excluded, high, largest))
    low, high = (torch.from_numpy(np.broadcast_to(end, len(columns)).copy()) for end in ends)
    return Grid(low, high, (high - low) / (2**bits - 1), bits)


def levels(values: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """Nearest levels of values ``[N, C]``, float64 ``[N, C]``, and a mask ``[N, C]`` of values outside of the range."""
    exact = values.double()
    safe = torch.where(grid.step > 0, grid.step, 1.0)
    outside = (exact < grid.low) | (exact > grid.high)
    return ((exact - grid.low) / safe).round().clamp(0, 2**grid.bits - 1), outside


def at_levels(levels: Tensor, low: Tensor, step: Tensor) -> Tensor:
    """Values of levels as float32; all arguments are float64 and broadcast."""
    return (low + levels * step).float()


def rounded(values: Tensor, grid: Grid) -> Tensor:
    """The result ``[N, C]`` float32 of :func:`quantize` and :func:`dequantize`; bit for bit on a CPU."""
    nearest, outside = levels(values, grid)
    return torch.where(outside, values, at_levels(nearest, grid.low, grid.step))


class Uniform(NamedTuple):
    """Values ``[N, C]`` on a grid; the error is at most half of the channel's ``step``."""

    codes: Codes
    """``[C, N]`` unsigned."""
    low: NDArray[np.float64]
    """Value of code 0 ``[C]``."""
    step: NDArray[np.float64]
    """Distance between neighbouring levels ``[C]``."""
    places: NDArray[np.uint32]
    """Indices of the exceptions in the flattened ``[C, N]``, ascending ``[E]``."""
    exceptions: Floats
    """Exact values of the exceptions ``[E]``."""


def quantize(values: Floats, grid: Grid) -> Uniform:
    """Round finite values ``[N, C]`` to the levels of a grid; values outside of its range are stored exactly."""
    nearest, outside = levels(torch.from_numpy(values), grid)
    codes = nearest.T.numpy().astype(code_type(grid.bits), order="C")
    places = np.flatnonzero(outside.T.numpy()).astype(np.uint32)
    exceptions = np.ascontiguousarray(values.T).reshape(-1)[places]
    return Uniform(codes, grid.low.numpy(), grid.step.numpy(), places, exceptions)


def dequantize(packed: Uniform) -> Floats:
    """Values ``[N, C]`` of the result of :func:`quantize`."""
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
    """Positions in blocks of neighbours; per block and axis, the error is at most (high - low) / (2^bits - 1) / 2."""

    deltas: NDArray[np.uint64]
    """Differences of consecutive Morton codes, which ascend in a block; each block starts with a whole code ``[N]``."""
    low: Floats
    """Lower bounds of the blocks ``[B, 3]``."""
    high: Floats
    """Upper bounds of the blocks ``[B, 3]``."""


def quantize_positions(means: Floats, bits: int, size: int) -> tuple[Blocks, NDArray[np.int64]]:
    """Round positions to a grid in each block, and sort each block by Morton code, so that differences are small.

    Args:
        means: ``[N, 3]``, finite, in the order of ``morton.scene_order``.
        bits: bits per coordinate, 1 to 21.
        size: primitives per block.

    Returns:
        The blocks, and the permutation ``[N]`` from their order to rows of ``means``.
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
    """Positions ``[N, 3]`` of the result of :func:`quantize_positions`, in the order of the blocks."""
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
    """Levels of the three smallest components, in the order wxyz, unsigned ``[3, N]``."""
    largest: NDArray[np.uint8]
    """Index in wxyz of the largest component, which is not stored ``[N]``."""


def rotation_bound(bits: int) -> float:
    """Maximum error of the angle of a rotation, radians.

    Each of three components has an error of at most e = sqrt(1/2) / (2^bits - 1), and their vector v one of at most
    sqrt(3) e. On the sphere of unit quaternions, where the fourth component is w = sqrt(1 - |v|^2), a step of v is
    stretched by at most 1 / w. The largest of four components is at least 1/2, so |v| is at most sqrt(3)/2 before
    rounding. The angle of a rotation is twice the angle on that sphere.
    """
    off = 3**0.5 * _ROOT_HALF / (2**bits - 1)
    return 2 * off / (1 - (3**0.5 / 2 + off) ** 2) ** 0.5


def rotation_levels(quats: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Nearest levels of the three smallest components, float64 ``[3, N]``, and the index of the largest ``[N]``.

    Args:
        quats: wxyz ``[N, 4]``, finite, any length; zero quaternions are the identity, as in the rasterisers.
        bits: bits per component, 4 to 16.
    """
    q = quats.double()
    scale = q.abs().amax(dim=1, keepdim=True)
    q = torch.where(scale > 0, q / torch.where(scale > 0, scale, 1.0), q.new_tensor([1.0, 0.0, 0.0, 0.0]))
    largest = q.abs().argmax(dim=1)
    # Written out: a reduction could round differently for another number of rows.
    w, x, y, z = q.T
    length = (w * w + x * x + y * y + z * z).sqrt()
    sign = torch.where(q.gather(1, largest[:, None])[:, 0] < 0, -1.0, 1.0)
    w, x, y, z = (component / length * sign for component in (w, x, y, z))
    three = torch.stack(
        [torch.where(largest <= i, after, before) for i, (before, after) in enumerate(((w, x), (x, y), (y, z)))]
    )
    nearest = ((three / _ROOT_HALF + 1) / 2 * (2**bits - 1)).round()
    return nearest.clamp(0, 2**bits - 1), largest


def _component(levels: Tensor, bits: int) -> Tensor:
    """Components of unit quaternions, float32, of levels, float64."""
    return ((levels * 2 / (2**bits - 1) - 1) * _ROOT_HALF).float()


def _unit(three: Tensor, largest: Tensor) -> Tensor:
    """Unit quaternions wxyz ``[N, 4]`` from their three smallest components ``[3, N]``; the largest one is positive."""
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
    """The result ``[N, 4]`` of :func:`quantize_rotations` and :func:`dequantize_rotations`; bit for bit on a CPU."""
    nearest, largest = rotation_levels(quats, bits)
    return _unit(_component(nearest, bits), largest)


def quantize_rotations(quats: Floats, bits: int) -> Rotations:
    """Quantise the three smallest components of each quaternion; arguments as in :func:`rotation_levels`."""
    nearest, largest = rotation_levels(torch.from_numpy(quats), bits)
    return Rotations(nearest.numpy().astype(code_type(bits)), largest.numpy().astype(np.uint8))


def dequantize_rotations(packed: Rotations, bits: int) -> Floats:
    """Unit quaternions wxyz ``[N, 4]`` of a result of :func:`quantize_rotations`; the largest component is positive."""
    every = torch.arange(int(np.iinfo(packed.codes.dtype).max) + 1, dtype=torch.float64)
    three = _component(every, bits).numpy()[packed.codes]
    out: Floats = _unit(torch.from_numpy(three), torch.from_numpy(packed.largest)).numpy()
    return out


def weight_steps(weight: Tensor, bits: int) -> Tensor:
    """Step of each output channel, float32 ``[O]``: the largest weight of ``[O, ...]`` is at level 2^(bits - 1) - 1."""
    step = weight.reshape(len(weight), -1).double().abs().amax(dim=1) / (2 ** (bits - 1) - 1)
    stored = step.float()
    # Round up, so that the largest weight does not exceed the last level.
    return torch.where(step > 0, torch.nextafter(stored, torch.full_like(stored, torch.inf)), 0.0)


def weight_levels(weight: Tensor, step: Tensor, bits: int) -> Tensor:
    """Nearest levels of weights ``[O, ...]``, float64."""
    wide = step.reshape(-1, *([1] * (weight.ndim - 1))).double()
    last = 2 ** (bits - 1) - 1
    return (weight.double() / torch.where(wide > 0, wide, 1.0)).round().clamp(-last, last)


def weights_at(levels: Tensor, step: Tensor) -> Tensor:
    """Weights, float32, of levels ``[O, ...]``."""
    return levels.float() * step.reshape(-1, *([1] * (levels.ndim - 1)))


def rounded_weights(weight: Tensor, step: Tensor, bits: int) -> Tensor:
    """The result ``[O, ...]`` of :func:`quantize_weights` and :func:`dequantize_weights`; bit for bit on a CPU."""
    return weights_at(weight_levels(weight, step, bits), step)


def quantize_weights(weight: Floats, step: Floats, bits: int = 8) -> NDArray[np.int8]:
    """Round weights; with steps of :func:`weight_steps`, the error is at most half of the channel's step.

    Args:
        weight: ``[O, ...]``, finite.
        step: step of each output channel ``[O]``.
        bits: 2 to 8.

    Returns:
        Codes ``[O, ...]``.
    """
    codes: NDArray[np.int8] = (
        weight_levels(torch.from_numpy(weight), torch.from_numpy(step), bits).to(torch.int8).numpy()
    )
    return codes


def dequantize_weights(codes: NDArray[np.int8], step: Floats) -> Floats:
    """Weights ``[O, ...]`` of the result of :func:`quantize_weights`."""
    out: Floats = weights_at(torch.from_numpy(codes.astype(np.float32)), torch.from_numpy(step.copy())).numpy()
    return out
