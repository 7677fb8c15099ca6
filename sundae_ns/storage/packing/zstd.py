"""A decoder of zstandard frames (RFC 8878), the twin of ``web/src/scene/zstd.ts``.

Decoders of different libraries and versions accept different damaged frames. Every reader must give the same verdict on
a packed scene, so both have the same decoder: every bit of a frame must be used, and nothing may follow it. Frames have
neither checksum nor dictionary, and state their size, as the writer's do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sundae_ns.rasterization.cpu.parallel import compiled

_MAGIC = b"\x28\xb5\x2f\xfd"
_LENGTHS, _OFFSETS, _MATCHES = range(3)
"""Kinds of codes of a sequence: lengths of literals, offsets, lengths of matches."""
_LONGEST_CODE = 11
"""Most bits of a Huffman code."""
_MOST_LITERALS = 1 << 17
"""Most literals of a block."""


def _baselines(first: int, bits: list[int]) -> NDArray[np.int64]:
    """The smallest value of each code, and how many bits follow it ``[2, codes]``."""
    return np.array([first + np.cumsum([0, *(1 << np.array(bits[:-1]))]), bits], np.int64)


_TAIL = [*range(7, 17)]
_VALUES = (
    _baselines(0, [0] * 16 + [1, 1, 1, 1, 2, 2, 3, 3, 4, 6, *_TAIL]),
    _baselines(1, [*range(32)]),
    _baselines(3, [0] * 32 + [1, 1, 1, 1, 2, 2, 3, 3, 4, 4, 5, *_TAIL]),
)
_DEFAULTS = (
    np.array([4, 3] + [2] * 11 + [1] * 3 + [2] * 9 + [3, 2] + [1] * 5 + [-1] * 4, np.int64),
    np.array([1] * 6 + [2] * 3 + [1] * 15 + [-1] * 5, np.int64),
    np.array([1, 4, 3] + [2] * 6 + [1] * 37 + [-1] * 7, np.int64),
)
"""Probabilities of the codes where a block states none, in 64ths, 32ths and 64ths."""


@compiled
def _highest(value):  # type: ignore[no-untyped-def]
    """Place of the highest bit of a positive number."""
    place = -1
    while value > 0:
        value >>= 1
        place += 1
    return place


@compiled
def _opened(src, at, end):  # type: ignore[no-untyped-def]
    """Number of bits of a stream, which is read backwards from the mark at its end; -1 without one."""
    if at >= end or src[end - 1] == 0:
        return -1
    return 8 * (end - at - 1) + _highest(src[end - 1])


@compiled
def _bits(src, at, end, place, count):  # type: ignore[no-untyped-def]
    """The ``count`` bits, at most 40, from ``place`` on of the bytes from ``at`` to ``end``; 0 outside of them."""
    byte, value = place >> 3, 0
    for k in range(((place & 7) + count + 7) >> 3):
        if 0 <= byte + k < end - at:
            value |= src[at + byte + k] << (8 * k)
    return (value >> (place & 7)) & ((1 << count) - 1)


@compiled
def _spread(chances, count, log, table):  # type: ignore[no-untyped-def]
    """Fill a decoding table ``[3, 2^log]`` (symbols, bits, bases of the next state); whether the chances fill it."""
    size = 1 << log
    rare, place, step = size, 0, (size >> 1) + (size >> 3) + 3
    following = np.zeros(256, np.int64)
    for symbol in range(count):
        following[symbol] = abs(chances[symbol])
        if chances[symbol] < 0:
            rare -= 1
            table[0, rare] = symbol
    for symbol in range(count):
        for _ in range(chances[symbol]):
            table[0, place] = symbol
            place = (place + step) & (size - 1)
            while place >= rare:
                place = (place + step) & (size - 1)
    for i in range(size):
        symbol = table[0, i]
        state = following[symbol]
        following[symbol] += 1
        table[1, i] = log - _highest(state)
        table[2, i] = (state << table[1, i]) - size
    return place == 0


@compiled
def _read_table(src, at, end, most_log, most_symbol, table):  # type: ignore[no-untyped-def]
    """Read a table of finite state entropy; the byte behind it (-1 for an invalid one) and its log."""
    log, place = _bits(src, at, end, 0, 4) + 5, 4
    if log > most_log:
        return -1, 0
    chances = np.zeros(256, np.int64)
    left, symbol = 1 << log, 0
    while left > 0:
        if symbol > most_symbol:
            return -1, 0
        # Numbers from 0 to left + 1; the smallest take one bit less.
        width = _highest(left + 1) + 1
        short = (1 << width) - 2 - left
        value = _bits(src, at, end, place, width)
        small = value & ((1 << (width - 1)) - 1)
        if small < short:
            value, width = small, width - 1
        elif value != small:
            value -= short
        place += width
        chances[symbol] = value - 1
        left -= abs(value - 1)
        symbol += 1
        while value == 1:
            zeros = _bits(src, at, end, place, 2)
            place += 2
            symbol += zeros
            if zeros < 3 or symbol > most_symbol:
                break
    behind = at + ((place + 7) >> 3)
    if symbol > most_symbol + 1 or behind > end or not _spread(chances, symbol, log, table):
        return -1, 0
    return behind, log


@compiled
def _read_weights(src, at, end, weights):  # type: ignore[no-untyped-def]
    """Read Huffman weights that are coded by finite state entropy; their number, or -1."""
    table = np.zeros((3, 64), np.int64)
    at, log = _read_table(src, at, end, 6, 15, table)
    place = -1 if at < 0 else _opened(src, at, end)
    if place < 2 * log:
        return -1
    place -= log
    state = _bits(src, at, end, place, log)
    place -= log
    other = _bits(src, at, end, place, log)
    count = 0
    # Two states take turns; the bits end in the middle of a turn, and the other state has the last weight.
    while count < 254:
        weights[count] = table[0, state]
        count += 1
        place -= table[1, state]
        if place < 0:
            weights[count] = table[0, other]
            return count + 1
        state, other = other, table[2, state] + _bits(src, at, end, place, table[1, state])
    return -1


@compiled
def _read_huffman(src, at, end, codes):  # type: ignore[no-untyped-def]
    """Read Huffman codes ``[2, 2^log]`` (symbols, lengths); the byte behind (-1 for invalid ones) and their log."""
    weights = np.zeros(256, np.int64)
    head = _bits(src, at, end, 0, 8)
    at += 1
    if head < 128:
        behind = at + head
        count = _read_weights(src, at, behind, weights) if behind <= end else -1
    else:
        count = head - 127
        behind = at + (count + 1) // 2
        if behind > end:
            return -1, 0
        for i in range(count):
            weights[i] = (src[at + i // 2] >> (4 if i % 2 == 0 else 0)) & 15
    if count < 1:
        return -1, 0
    total, ones = 0, 0
    for i in range(count):
        total += (1 << weights[i]) >> 1
        ones += weights[i] == 1
    log = _highest(total) + 1
    rest = (1 << log) - total
    # The last weight fills the table.
    weights[count] = _highest(rest) + 1
    ones += weights[count] == 1
    if log > _LONGEST_CODE or total == 0 or rest & (rest - 1) != 0 or ones < 2 or ones % 2 != 0:
        return -1, 0
    place = 0
    for weight in range(1, log + 1):
        for symbol in range(count + 1):
            if weights[symbol] == weight:
                stop = place + (1 << (weight - 1))
                codes[0, place:stop] = symbol
                codes[1, place:stop] = log + 1 - weight
                place = stop
    return behind, log


@compiled
def _read_stream(src, at, end, codes, log, out, first, count):  # type: ignore[no-untyped-def]
    """Write ``count`` Huffman symbols of one stream from ``first`` on; whether they are all of the stream."""
    place = _opened(src, at, end)
    for i in range(first, first + count):
        if place <= 0:
            return False
        index = _bits(src, at, end, place - log, log)
        out[i] = codes[0, index]
        place -= codes[1, index]
    return place == 0


@compiled
def _literals(src, at, end, codes, logs, out, space):  # type: ignore[no-untyped-def]
    """Write the literals of a block, at most ``space``; the byte behind them (-1 for invalid ones) and their number."""
    kind, form = _bits(src, at, end, 0, 2), _bits(src, at, end, 2, 2)
    width = ((1, 2, 1, 3) if kind < 2 else (3, 3, 4, 5))[form]
    if at + width > end:
        return -1, 0
    head = _bits(src, at, end, 0, 8 * width)
    at += width
    if kind < 2:
        count = head >> (3 if width == 1 else 4)
        stop = at + (count if kind == 0 else 1)
        if stop > end or count > space:
            return -1, 0
        for i in range(count):
            out[i] = src[at + i] if kind == 0 else src[at]
        return stop, count
    size = (10, 10, 14, 18)[form]
    count, stop = (head >> 4) & ((1 << size) - 1), at + (head >> (4 + size))
    if stop > end or count > space:
        return -1, 0
    if kind == 2:
        at, logs[3] = _read_huffman(src, at, stop, codes)
    log = logs[3]
    if at < 0 or log < 1:
        return -1, 0
    if form == 0:
        return (stop if _read_stream(src, at, stop, codes, log, out, 0, count) else -1), count
    if count < 6 or at + 6 > stop:
        return -1, 0
    start, quarter = at + 6, (count + 3) // 4
    for k in range(4):
        behind = start + _bits(src, at, stop, 16 * k, 16) if k < 3 else stop
        number = quarter if k < 3 else count - 3 * quarter
        if behind > stop or not _read_stream(src, start, behind, codes, log, out, k * quarter, number):
            return -1, 0
        start = behind
    return stop, count


@compiled
def _read_tables(src, at, end, tables, logs):  # type: ignore[no-untyped-def]
    """Read the tables of a block's sequences; the byte behind them, or -1."""
    modes = src[at]
    at += 1
    if modes & 3 != 0:
        return -1
    for kind in range(3):
        mode, symbols = (modes >> (6 - 2 * kind)) & 3, (35, 31, 52)[kind]
        if mode == 0:
            logs[kind] = (6, 5, 6)[kind]
            _spread(_DEFAULTS[kind], len(_DEFAULTS[kind]), logs[kind], tables[kind])
        elif mode == 1:
            if at >= end or src[at] > symbols:
                return -1
            logs[kind], tables[kind, 0, 0], tables[kind, 1, 0], tables[kind, 2, 0] = 0, src[at], 0, 0
            at += 1
        elif mode == 2:
            at, logs[kind] = _read_table(src, at, end, (9, 8, 9)[kind], symbols, tables[kind])
        if at < 0 or logs[kind] < 0:
            return -1
    return at


@compiled
def _offset(value, short, recent):  # type: ignore[no-untyped-def]
    """The offset of a match; values up to 3 name a recent one, the next if no literals come before. 0 is invalid."""
    if value > 3:
        found, kept = value - 3, 2
    else:
        kept = value - 1 + (1 if short else 0)
        found = recent[kept] if kept < 3 else recent[0] - 1
        kept = min(kept, 2)
    for k in range(kept, 0, -1):
        recent[k] = recent[k - 1]
    recent[0] = found
    return found


@compiled
def _block(src, at, end, out, done, codes, tables, logs, recent, literals):  # type: ignore[no-untyped-def]
    """Write a compressed block from ``done`` on; the number of bytes then done, or -1."""
    at, given = _literals(src, at, end, codes, logs, literals, min(len(out) - done, _MOST_LITERALS))
    if at < 0 or at >= end:
        return -1
    count = src[at]
    at += 1
    if count >= 128:
        wide = 2 if count == 255 else 1
        if at + wide > end:
            return -1
        count = src[at] + (src[at + 1] << 8) + 0x7F00 if wide == 2 else ((count - 128) << 8) + src[at]
        at += wide
    used = 0
    if count > 0:
        at = _read_tables(src, at, end, tables, logs) if at < end else -1
        place = _opened(src, at, end) if at >= 0 else -1
        if place < logs[0] + logs[1] + logs[2] or at < 0:
            return -1
        states, values = np.zeros(3, np.int64), np.zeros(3, np.int64)
        for kind in range(3):
            place -= logs[kind]
            states[kind] = _bits(src, at, end, place, logs[kind])
        for i in range(count):
            for kind in (_OFFSETS, _MATCHES, _LENGTHS):
                code = tables[kind, 0, states[kind]]
                bits = _VALUES[kind][1, code]
                place -= bits
                values[kind] = _VALUES[kind][0, code] + _bits(src, at, end, place, bits)
            length, match = values[_LENGTHS], values[_MATCHES]
            offset = _offset(values[_OFFSETS], length == 0, recent)
            if place < 0 or length > given - used or length + match > len(out) - done:
                return -1
            for k in range(length):
                out[done + k] = literals[used + k]
            used, done = used + length, done + length
            if offset < 1 or offset > done:
                return -1
            for k in range(done, done + match):
                out[k] = out[k - offset]
            done += match
            for kind in (_LENGTHS, _MATCHES, _OFFSETS):
                bits = tables[kind, 1, states[kind]]
                if i < count - 1:
                    place -= bits
                    states[kind] = tables[kind, 2, states[kind]] + _bits(src, at, end, place, bits)
        at = end if place == 0 else -1
    rest = given - used
    if at != end or rest > len(out) - done:
        return -1
    for k in range(rest):
        out[done + k] = literals[used + k]
    return done + rest


@compiled
def _decode(src, at, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` from the blocks of a frame; whether they are whole, and of this size."""
    codes, tables = np.zeros((2, 1 << _LONGEST_CODE), np.int64), np.zeros((3, 3, 512), np.int64)
    logs, recent = np.array([-1, -1, -1, -1]), np.array([1, 4, 8])
    literals = np.zeros(min(len(out), _MOST_LITERALS), np.uint8)
    done, last = 0, 0
    while last == 0:
        if at + 3 > len(src):
            return False
        head = _bits(src, at, len(src), 0, 24)
        last, kind, length = head & 1, (head >> 1) & 3, head >> 3
        at += 3
        end = at + (1 if kind == 1 else length)
        if kind == 3 or end > len(src) or (kind < 2 and length > len(out) - done):
            return False
        if kind == 2:
            done = _block(src, at, end, out, done, codes, tables, logs, recent, literals)
            if done < 0:
                return False
        else:
            for k in range(length):
                out[done + k] = src[at] if kind == 1 else src[at + k]
            done += length
        at = end
    return at == len(src) and done == len(out)


def decompress(frame: bytes, size: int) -> NDArray[np.uint8]:
    """The content of a frame, as bytes ``[size]``.

    Args:
        frame: one whole frame.
        size: bytes of its content; no more are allocated.

    Raises:
        ValueError: the frame is damaged, or has another size.
    """
    at = _first_block(frame, size)
    out = np.zeros(size, np.uint8)
    if at < 0 or not _decode(np.frombuffer(frame, np.uint8).astype(np.int32), at, out):
        raise ValueError("the frame is damaged, or has another size")
    return out


def _first_block(frame: bytes, size: int) -> int:
    """Where the blocks of a frame begin that states ``size``; -1 for another frame."""
    if frame[:4] != _MAGIC or len(frame) < 5 or frame[4] & 0x1F:
        return -1
    single, kind = (frame[4] >> 5) & 1, frame[4] >> 6
    at, width = 6 - single, (single, 2, 4, 8)[kind]
    stated = int.from_bytes(frame[at : at + width], "little") + (256 if width == 2 else 0)
    return at + width if width > 0 and at + width <= len(frame) and stated == size else -1
