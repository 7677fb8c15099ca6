"""The decoder of frames, against zstandard's library."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest
import zstandard
from numpy.typing import NDArray

from sundae_ns.storage.packing import zstd

KINDS = ("four symbols", "normal", "zeros", "a period", "sorted", "a walk", "text")


def content(kind: str, size: int) -> bytes:
    g = np.random.default_rng(size)
    found: dict[str, NDArray[np.generic]] = {
        "four symbols": g.integers(0, 4, size),
        "normal": g.normal(0, 6, size).astype(int) % 256,
        "zeros": np.zeros(size),
        "a period": np.resize(g.integers(0, 256, 37), size),
        "sorted": np.sort(g.integers(0, 256, size)),
        "a walk": np.cumsum(g.integers(0, 3, size)) % 256,
        "text": np.resize(np.frombuffer((zstd.__doc__ or "").encode(), np.uint8), size),
    }
    return found[kind].astype(np.uint8).tobytes()


def frame_of(plain: bytes, level: int = 19, **options: bool) -> bytes:
    return zstandard.ZstdCompressor(level=level, **{"write_checksum": False, **options}).compress(plain)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_every_kind_are_decoded(kind: str) -> None:
    # More than 128 KiB take several blocks, which share tables and offsets.
    for size in (1, 2, 3, 60, 300, 2000, 300_000):
        plain = content(kind, size)
        for level in (-5, 1, 3, 19):
            assert zstd.decompress(frame_of(plain, level), size).tobytes() == plain, (size, level)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_decoded_is_what_the_library_decodes(kind: str) -> None:
    """Of a damaged frame; the library accepts some that this decoder refuses, but none the other way round."""
    rng = Random(kind)
    plain = content(kind, 900)
    good = frame_of(plain)
    accepted = 0
    for _ in range(300):
        frame = bytearray(good)
        for _ in range(rng.choice((1, 2, 5))):
            frame[rng.randrange(6, len(frame))] ^= 1 << rng.randrange(8)
        try:
            found = zstd.decompress(bytes(frame), len(plain))
        except ValueError:
            continue
        accepted += 1
        assert found.tobytes() == zstandard.ZstdDecompressor().decompress(bytes(frame), allow_extra_data=False)
    assert accepted < 300


def test_other_frames_are_refused() -> None:
    plain = content("normal", 2000)
    good = frame_of(plain)
    others = {
        "cut": good[:-1],
        "longer": good + b"\0",
        "two frames": good + good,
        "a frame that skips": b"\x50\x2a\x4d\x18\x01\0\0\0x" + good,
        "a checksum": frame_of(plain, write_checksum=True),
        "no size": frame_of(plain, write_content_size=False),
        "another size": frame_of(plain[:-1]),
        "no frame": plain,
        "empty": b"",
        "no blocks": good[:7],
        "a reserved block": good[:7] + bytes([good[7] | 6]) + good[8:],
    }
    for name, frame in others.items():
        with pytest.raises(ValueError, match="damaged"):
            zstd.decompress(frame, len(plain))
        assert name


def test_any_bytes_end_in_a_result_or_a_refusal() -> None:
    """Behind a valid header, where an index beyond an array would end the process."""
    rng = Random(0)
    for i in range(2000):
        size = rng.choice((1, 20, 255))
        body = rng.randbytes(rng.choice((3, 5, 20, 200)))
        block = len(body).to_bytes(3, "little")
        head = ((int.from_bytes(block, "little") << 3) | 5).to_bytes(3, "little")
        frame = b"\x28\xb5\x2f\xfd\x20" + bytes([size]) + (head + body if i % 2 else body)
        try:
            assert len(zstd.decompress(frame, size)) == size
        except ValueError:
            continue
