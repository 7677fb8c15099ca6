"""Entropy coding of whole numbers: a binary arithmetic coder whose probabilities adapt and are mixed (Mahoney, PAQ).

Each number is a few binary decisions. Each decision has a probability in every one of :data:`CONTEXTS` contexts, and a
small logistic regression mixes them. Encoder and decoder run the same loop, and it computes with integers below 2^53
only, so every machine and the web page (``web/src/scene/entropy.ts``) decode the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sundae_ns.io.pack.container import Array, Levels
from sundae_ns.rasterize.cpu.lanes import load, minimum, store
from sundae_ns.rasterize.cpu.parallel import borrowing, compiled, inlined, parallel_for

LARGEST = (1 << 24) - 1  # magnitude of a number
CONTEXTS = 4
NEIGHBOURS = 4  # earlier rows from which the contexts of a row are made
WINDOW = 128  # earlier rows among which they are searched
_MASK = 0xFFFFFFFF
_NODES = 144  # no power of two: contexts would share the sets of a cache
_LAST = 24
_CLASSES = 16
_KINDS = 63 + _CLASSES * _CLASSES
_EVEN = np.int64(1 << 15)  # as all constants given to inlined loops: numba compiles them anew for each literal int

Stream = NDArray[np.uint8]
Near = NDArray[np.int32]  # rows ``[N, NEIGHBOURS]`` before each row, the nearest first; -1 for none

# Probabilities of 12 bits ``[4095]`` for -2047 to 2047 in 256ths of their logits. The format fixes these numbers: other
# machines' exponentials must round to them (a test holds their hash).
_SQUASH = np.rint(4096 / (1 + np.exp(-np.arange(-2047, 2048) / 256))).clip(1, 4095).astype(np.int16)
_STRETCH = (np.searchsorted(_SQUASH, np.arange(4096), side="left").clip(0, 4094) - 2047).astype(np.int16)
_CLASS = np.repeat(np.arange(_CLASSES), 1 << (np.arange(_CLASSES) // 2 - 1).clip(0))  # of magnitudes to 255 and up
_RATES = (65536 * 5 // (5 * np.arange(256) + 8)).astype(np.int32)


@inlined  # as _decided and _number, so that the four numbers of the coder stay in registers: half the time
def _coded(coder, stream, chance, bit):  # type: ignore[no-untyped-def]
    """Write a bit that is 1 with ``chance`` of 65536, or read it if ``bit`` is -1; the bit, and the coder after it."""
    low, high, code, position = coder
    reading = bit < 0
    reach = high - low
    middle = low + (reach >> 16) * chance + (((reach & 0xFFFF) * chance) >> 16)
    if reading:
        bit = 1 if code <= middle else 0
    if bit == 1:
        high = middle
    else:
        low = middle + 1
    while (low ^ high) >> 24 == 0:
        if reading:
            code = ((code << 8) & _MASK) | (stream[position] if position < len(stream) else 0)
        else:
            stream[position] = high >> 24
        position += 1
        low = (low << 8) & _MASK
        high = ((high << 8) & _MASK) | 255
    return bit, (low, high, code, position)


def _chances(contexts: int, decisions: int) -> tuple[Array, ...]:
    """Chances in all contexts, 16 bits above the count of their decisions, weights of the mix, and room for lanes."""
    model = np.full(contexts * _NODES, _EVEN << 7, np.uint32)
    return model, np.full((decisions * _NODES, CONTEXTS), 0x5000, np.int32), np.zeros(12, np.int32)


@inlined
def _decided(coder, stream, chances, kinds, row, node, bit):  # type: ignore[no-untyped-def]
    """Code the decision ``node`` with the mix of its chances in four contexts, and adapt them; the bit, the coder."""
    model, weights, scratch = chances
    # Unsigned: of other numbers numba asks whether they count from the end.
    a, b = np.uint32(kinds[0] * _NODES + node), np.uint32(kinds[1] * _NODES + node)
    c, d, row = np.uint32(kinds[2] * _NODES + node), np.uint32(kinds[3] * _NODES + node), np.uint32(row)
    of_a, of_b = _STRETCH[model[a] >> 11], _STRETCH[model[b] >> 11]
    of_c, of_d = _STRETCH[model[c] >> 11], _STRETCH[model[d] >> 11]
    total = of_a * weights[row, 0] + of_b * weights[row, 1] + of_c * weights[row, 2] + of_d * weights[row, 3]
    chance = _SQUASH[min(max(total >> 16, -2047), 2047) + 2047]
    scratch[0], scratch[1], scratch[2], scratch[3] = model[a], model[b], model[c], model[d]
    scratch[4], scratch[5], scratch[6], scratch[7] = of_a, of_b, of_c, of_d
    scratch[8], scratch[9] = _RATES[model[a] & 127], _RATES[model[b] & 127]
    scratch[10], scratch[11] = _RATES[model[c] & 127], _RATES[model[d] & 127]
    bit, coder = _coded(coder, stream, chance << 4, bit)
    # They adapt in lanes; the mix above is scalar, as a decoder waits for it. max(x, y) is y - min(y - x, 0).
    states, most = load(scratch, 0), 1 << 19
    weight = load(weights, row * CONTEXTS) + ((load(scratch, 4) * (((bit << 12) - chance) * 10) + 0x8000) >> 16)
    store(weights, row * CONTEXTS, minimum(0 - minimum(0 - weight, most), most))
    old = states >> 7
    moved = minimum(old + ((((bit * 65535 - old) >> 3) * load(scratch, 8)) >> 13), 65519)
    store(scratch, 0, (16 - minimum(16 - moved, 0)) * 128 + minimum((states & 127) + 1, 127))
    model[a], model[b], model[c], model[d] = scratch[0], scratch[1], scratch[2], scratch[3]
    return bit, coder


@inlined
def _number(coder, stream, chances, kinds, first, value, reading):  # type: ignore[no-untyped-def]
    """Code a number: is it 0, its sign, how many binary digits it has, and these; the number, and the coder."""
    bit, coder = _decided(coder, stream, chances, kinds, first, np.int64(0), -1 if reading else int(value == 0))
    if bit == 1:
        return 0, coder
    bit = -1 if reading else (1 if value < 0 else 0)
    negative, coder = _decided(coder, stream, chances, kinds, first + 1, np.int64(1), bit)
    size = abs(value)
    digits = 0
    while digits < _LAST - 1:
        node = 2 * min(1 + digits, 16) + negative
        bit = -1 if reading else (1 if size >> (digits + 1) > 0 else 0)
        bit, coder = _decided(coder, stream, chances, kinds, first + node, node, bit)
        if bit == 0:
            break
        digits += 1
    magnitude = 1
    for k in range(digits):
        bit = -1 if reading else (size >> (digits - 1 - k)) & 1
        if k < 2 and digits < 15:
            node = 2 * (17 + 3 * digits + (k + (magnitude & 1) if k else 0)) + negative
            bit, coder = _decided(coder, stream, chances, kinds, first + node, node, bit)
        else:
            bit, coder = _coded(coder, stream, _EVEN, bit)
        magnitude = 2 * magnitude + bit
    return -magnitude if negative == 1 else magnitude, coder


@compiled
def _magnitude(value):  # type: ignore[no-untyped-def]
    """Class of a magnitude, 0 to 15: two classes for each doubling."""
    return _CLASS[np.uint32(min(abs(value), 255))]


@compiled
def _signed(value):  # type: ignore[no-untyped-def]
    """Class of a number, 0 to 30."""
    kind = _magnitude(value)
    return _CLASSES - 1 + (kind if value > 0 else -kind)


@borrowing
def _run(levels, near, chances, stream, coder, reading):  # type: ignore[no-untyped-def]
    """Code levels ``[N, C]`` row after row; the coder after them."""
    for i in range(len(levels)):
        total = 0
        for k in range(levels.shape[1]):
            around, nearest, amount = 0, 0, 0
            for q in range(NEIGHBOURS):
                j = near[i, q]
                if j >= 0:
                    value = levels[j, k]
                    around += value
                    amount += abs(value)
                    if q == 0:
                        nearest = value
            start = k * _KINDS
            sizes = _magnitude(amount >> 1) * _CLASSES + _magnitude(total)
            kinds = start, start + 1 + _signed(nearest), start + 32 + _signed(around >> 2), start + 63 + sizes
            value, coder = _number(coder, stream, chances, kinds, k * _NODES, levels[i, k], reading)
            levels[i, k] = value
            total += abs(value)
    return coder


@compiled
def _search(begin, end, cells, block, near):  # type: ignore[no-untyped-def]
    """Fill ``near`` with the nearest earlier rows of the same block, the nearest first."""
    least = np.empty(NEIGHBOURS, np.int64)
    for i in range(begin, end):
        least[:] = 1 << 62
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        for j in range(i - 1, max(i - WINDOW, i // block * block) - 1, -1):
            distance = (cells[j, 0] - x) ** 2 + (cells[j, 1] - y) ** 2 + (cells[j, 2] - z) ** 2
            if distance < least[NEIGHBOURS - 1]:
                at = NEIGHBOURS - 1
                while at > 0 and least[at - 1] > distance:
                    least[at], near[i, at] = least[at - 1], near[i, at - 1]
                    at -= 1
                least[at], near[i, at] = distance, j


@borrowing
def _run_gaps(codes, block, bits, chances, stream, coder, reading):  # type: ignore[no-untyped-def]
    """Code ascending Morton codes ``[N]``: the number of digits of each difference, and its digits; the coder after."""
    last, before, average = 0, 0, 0
    for i in range(len(codes)):
        gap, digits = 0, 0
        previous = 0 if i % block == 0 else codes[i - 1]
        if not reading:
            gap = codes[i] - previous
            while gap >> digits > 0:
                digits += 1
        kinds = np.int64(0), 1 + last, 65 + before, 129 + (average >> 2)
        node = np.int64(1)
        for k in range(6):
            bit = -1 if reading else (digits >> (5 - k)) & 1
            bit, coder = _decided(coder, stream, chances, kinds, node, node, bit)
            node = 2 * node + bit
        digits = min(node - 64, 3 * bits)
        size = min(digits, 1)
        for k in range(digits - 2, -1, -1):
            bit = -1 if reading else (gap >> k) & 1
            kind = digits - 2 - k
            if kind < 2:
                node = np.int64(64 + (1 if kind == 0 else size & 3))
                bit, coder = _decided(coder, stream, chances, kinds, node, node, bit)
            else:
                bit, coder = _coded(coder, stream, _EVEN, bit)
            size = 2 * size + bit
        # A hostile stream must not leave the grid.
        codes[i] = min(previous + size, (1 << 3 * bits) - 1)
        last, before = digits, last
        average += digits - (average >> 2)
    return coder


def encode_gaps(codes: NDArray[np.uint64], block: int, bits: int) -> Stream:
    """Code Morton codes of cells, which ascend in each block."""
    return _written(_run_gaps, len(codes) * 12 + 16, codes.astype(np.int64), block, bits, _chances(1 + 3 * 64, 1))


def decode_gaps(stream: Stream, count: int, block: int, bits: int) -> NDArray[np.uint64]:
    """Morton codes ``[N]`` from :func:`encode_gaps`; ``ValueError`` if the stream does not end with its last number."""
    codes = np.zeros(count, np.int64)
    _read(_run_gaps, stream, codes, block, bits, _chances(1 + 3 * 64, 1))
    return codes.astype(np.uint64)


def neighbours_of(cells: Array, block: int) -> Near:
    """Nearest earlier rows ``[N, NEIGHBOURS]`` in the same block of cells ``[N, 3]`` below 2^21; -1 for none."""
    near = np.full((len(cells), NEIGHBOURS), -1, np.int32)
    parallel_for(_search, len(near), np.ascontiguousarray(cells, np.int64), block, near, min_per_thread=1000)
    return near


def predecessors(count: int) -> Near:
    """The rows just before each row, for numbers without positions."""
    rows = np.arange(count, dtype=np.int32)[:, None] - np.arange(1, NEIGHBOURS + 1, dtype=np.int32)
    return np.maximum(rows, -1)


def encode_levels(levels: Array, near: Near) -> Stream:
    """Code numbers ``[N, C]`` of at most :data:`LARGEST`, given the neighbours of each row."""
    values = np.ascontiguousarray(levels, np.int32).copy()
    return _written(_run, values.size * 5 + 16, values, near, _chances(_KINDS * levels.shape[1], levels.shape[1]))


def decode_levels(stream: Stream, width: int, near: Near) -> Levels:
    """Numbers ``[N, C]`` from :func:`encode_levels`; ``ValueError`` if the stream does not end with its last number."""
    levels = np.zeros((len(near), width), np.int32)
    _read(_run, stream, levels, near, _chances(_KINDS * width, width))
    return levels


def _written(run: Callable[..., tuple[int, ...]], size: int, *arguments: Any) -> Stream:
    """The bytes that a loop writes, at most ``size``."""
    stream = np.zeros(size, np.uint8)
    _, high, _, end = run(*arguments, stream, (0, _MASK, 0, 0), False)
    # One more byte: it and the zeros that a decoder adds are between the two ends.
    stream[end] = high >> 24
    return stream[: end + 1]


def _read(run: Callable[..., tuple[int, ...]], stream: Stream, *arguments: Any) -> None:
    """Fill the arguments of a loop from a stream; refuse a stream of more or fewer numbers."""
    coder = 0, _MASK, int.from_bytes(bytes(stream[:4]).ljust(4, b"\0"), "big"), 4
    *_, position = run(*arguments, stream.copy(), coder, True)  # the loop takes no read-only arrays
    # A decoder has read four bytes where the encoder wrote the last one.
    if position - 3 != len(stream):
        raise ValueError("a stream does not end with its last number")
