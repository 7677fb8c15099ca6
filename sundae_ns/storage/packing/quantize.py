"""Quantisation: ranges robust to outliers, positions in blocks, rotations by three components, weights of the head.

Error bounds do not count the rounding of the result to float32 (half a unit in the last place). Rounding is implemented
once, in torch: files store levels, and training with rounding uses the values of the same levels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.storage.packing.container import Array, Encoded, Floats
from sundae_ns.storage.packing.morton import interleave, separate

TAIL = 0.001
"""Fraction of the values of a channel at either end that may lie outside of its range; they are stored exactly."""
_ROOT_HALF = 0.5**0.5
_FOUR_PAIRS = np.array([0, 2, 4, 6], np.uint8)


def code_type(bits: int) -> type[np.unsignedinteger[Any]]:
    """Smallest unsigned integer type with at least ``bits`` bits, at most 16."""
    return np.uint8 if bits <= 8 else np.uint16


@dataclass(frozen=True, eq=False)
class Uniform:
    """Codec of values ``[N, C]`` by even levels of each channel; see :func:`fit_uniform`."""

    low: Tensor
    """Value of code 0, float64 ``[C]``."""
    high: Tensor
    """Value of the last code, float64 ``[C]``; values outside of [low, high] are stored exactly."""
    step: Tensor
    """Distance between neighbouring levels, 0 for a constant channel, float64 ``[C]``."""
    bits: int
    differences: bool
    """Store the codes of channels 0 and 2 as differences from those of channel 1."""

    def encode(self, values: Floats) -> Encoded:
        """Round finite values; ``places`` index the exceptions in the flattened ``[C, N]``."""
        nearest, outside = self.levels(torch.from_numpy(values))
        codes = nearest.T.numpy().astype(code_type(self.bits), order="C")
        places = np.flatnonzero(outside.T.numpy()).astype(np.uint32)
        low, step = self.low.tolist(), self.step.numpy()
        about = {"codec": "uniform", "bits": self.bits, "low": low, "step": step.tolist(), "bound": (step / 2).tolist()}
        if self.differences:
            about["differences"] = True
            codes = np.stack([codes[0] - codes[1], codes[1], codes[2] - codes[1]])
        exceptions = np.ascontiguousarray(values.T).reshape(-1)[places]
        return about, {"codes": codes, "places": places, "exceptions": exceptions}

    def rounded(self, values: Tensor) -> Tensor:
        """Return the values that a reader decodes, float32; bit for bit on a CPU."""
        nearest, outside = self.levels(values)
        return torch.where(outside, values, _at_levels(nearest, self.low, self.step))

    def levels(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Nearest levels, float64 ``[N, C]``, and a mask ``[N, C]`` of values outside of the range."""
        exact = values.double()
        safe = torch.where(self.step > 0, self.step, 1.0)
        outside = (exact < self.low) | (exact > self.high)
        return ((exact - self.low) / safe).round().clamp(0, 2**self.bits - 1), outside


def fit_uniform(values: Floats, bits: int, *, color: bool = False) -> Uniform:
    """Fit levels to values; the outermost :data:`TAIL` at either end is excluded if it is far from the others.

    Args:
        values: ``[N, C]``, finite, N at least 1.
        color: the values are colours ``[N, 3]``, which correlate: use one range for all channels, and store differences.
    """
    columns = values.T.astype(np.float64)
    rows = columns.reshape(1, -1) if color else columns
    smallest, largest = rows.min(axis=1), rows.max(axis=1)
    low, high = np.quantile(rows, [TAIL, 1 - TAIL], axis=1, method="nearest")
    # Exclude the tails only if that makes the step a quarter finer; else the exceptions cost more than they save.
    excluded = 1.25 * (high - low) < largest - smallest
    ends = (np.where(excluded, low, smallest), np.where(excluded, high, largest))
    low, high = (torch.from_numpy(np.broadcast_to(end, len(columns)).copy()) for end in ends)
    return Uniform(low, high, (high - low) / (2**bits - 1), bits, color)


def dequantize(
    codes: Array, low: NDArray[np.float64], step: NDArray[np.float64], places: NDArray[np.uint32], exceptions: Floats
) -> Floats:
    """Values ``[N, C]`` from the arrays of :meth:`Uniform.encode`, with codes that are not differences ``[C, N]``.

    The error is at most half of the channel's step.
    """
    channels, n = codes.shape
    every = torch.arange(int(np.iinfo(codes.dtype).max) + 1, dtype=torch.float64)
    tables = _at_levels(every, *(torch.from_numpy(ends)[:, None] for ends in (low, step))).numpy()
    out = np.empty((n, channels), np.float32)
    for c in range(channels):
        out[:, c] = tables[c][codes[c]]
    column, row = np.divmod(places.astype(np.int64), max(n, 1))
    out[row, column] = exceptions
    return out


def _at_levels(levels: Tensor, low: Tensor, step: Tensor) -> Tensor:
    return (low + levels * step).float()


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


@dataclass(frozen=True, eq=False)
class Rotations:
    """Codec of quaternions ``[N, 4]`` wxyz by their three smallest components; see :func:`rotation_bound`."""

    bits: int
    """Bits per component, 4 to 16."""

    def encode(self, values: Floats) -> Encoded:
        """Quantise finite quaternions of any length; zero ones are the identity, as in the rasterisers."""
        nearest, largest = _rotation_levels(torch.from_numpy(values), self.bits)
        codes = nearest.numpy().astype(code_type(self.bits))
        about = {"codec": "smallest-three", "bits": self.bits, "bound": rotation_bound(self.bits)}
        return about, {"codes": codes, "largest": _pack_pairs_of_bits(largest.numpy().astype(np.uint8))}

    def rounded(self, values: Tensor) -> Tensor:
        """Return the unit quaternions that a reader decodes; bit for bit on a CPU."""
        nearest, largest = _rotation_levels(values, self.bits)
        return _unit(_component(nearest, self.bits), largest)


def dequantize_rotations(codes: Array, largest: NDArray[np.uint8], bits: int) -> Floats:
    """Unit quaternions wxyz ``[N, 4]`` from the arrays of :meth:`Rotations.encode`; the largest component is positive.

    Args:
        codes: levels of the three smallest components, in the order wxyz ``[3, N]``.
        largest: index in wxyz of the component that is not stored, two bits each ``[ceil(N / 4)]``.
        bits: bits per component.
    """
    every = torch.arange(int(np.iinfo(codes.dtype).max) + 1, dtype=torch.float64)
    three = _component(every, bits).numpy()[codes]
    pairs = (largest[:, None] >> _FOUR_PAIRS & np.uint8(3)).reshape(-1)[: codes.shape[1]]
    out: Floats = _unit(torch.from_numpy(three), torch.from_numpy(pairs)).numpy()
    return out


def _pack_pairs_of_bits(values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pack two-bit numbers ``[N]`` four to a byte, the first in the lowest bits."""
    four = np.pad(values, (0, -len(values) % 4)).reshape(-1, 4)
    joined: NDArray[np.uint8] = np.bitwise_or.reduce(four << _FOUR_PAIRS, axis=1)
    return joined


def rotation_bound(bits: int) -> float:
    """Maximum error of the angle of a rotation, radians.

    Each of three components has an error of at most e = sqrt(1/2) / (2^bits - 1), and their vector v one of at most
    sqrt(3) e. On the sphere of unit quaternions, where the fourth component is w = sqrt(1 - |v|^2), a step of v is
    stretched by at most 1 / w. The largest of four components is at least 1/2, so |v| is at most sqrt(3)/2 before
    rounding. The angle of a rotation is twice the angle on that sphere.
    """
    off = 3**0.5 * _ROOT_HALF / (2**bits - 1)
    return 2 * off / (1 - (3**0.5 / 2 + off) ** 2) ** 0.5


def _rotation_levels(quats: Tensor, bits: int) -> tuple[Tensor, Tensor]:
    """Nearest levels of the three smallest components, float64 ``[3, N]``, and the index of the largest ``[N]``."""
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


def weight_steps(weight: Tensor, bits: int) -> Tensor:
    """Step of each output channel, float32 ``[O]``: the largest weight of ``[O, ...]`` is at level 2^(bits - 1) - 1."""
    step = weight.reshape(len(weight), -1).double().abs().amax(dim=1) / (2 ** (bits - 1) - 1)
    stored = step.float()
    # Round up, so that the largest weight does not exceed the last level.
    return torch.where(step > 0, torch.nextafter(stored, torch.full_like(stored, torch.inf)), 0.0)


def weight_levels(weight: Tensor, step: Tensor, bits: int) -> Tensor:
    """Nearest levels of weights ``[O, ...]``, float64; the error is at most half of the channel's step."""
    wide = step.reshape(-1, *([1] * (weight.ndim - 1))).double()
    last = 2 ** (bits - 1) - 1
    return (weight.double() / torch.where(wide > 0, wide, 1.0)).round().clamp(-last, last)


def weights_at(levels: Tensor, step: Tensor) -> Tensor:
    """Weights ``[O, ...]``, float32, of levels of any dtype and steps ``[O]``."""
    return levels.float() * step.reshape(-1, *([1] * (levels.ndim - 1)))
