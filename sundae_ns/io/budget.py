"""The one budget of all readers, of memory and so of time: what a file may unpack to follows from its own bytes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from io import BufferedIOBase
from typing import IO, Any

from torch import Tensor

from sundae_ns.core.gaussians import concatenated, num_gaussians, sh_degree_of

SPARE, RATIO = 64 << 20, 32  # bytes, and bytes for each byte of the file; a real .sog has 24, a .spz 12
_MOST_JSON = 8 << 20


def afford(unpacked: int, size: int, spare: int = SPARE, ratio: int = RATIO) -> None:
    """Raise ``ValueError`` if a file of ``size`` bytes may not unpack to ``unpacked`` bytes."""
    if unpacked > spare + ratio * size:
        raise ValueError(f"{size:,} bytes would unpack to {unpacked:,}")


def afford_gaussians(count: int, coefficients: int, size: int) -> None:
    """As :func:`afford`, for float32 Gaussians with ``coefficients`` SH terms of degrees 1 and up in each channel."""
    if count < 1 or sh_degree_of(coefficients) is None:
        raise ValueError(f"it states {count:,} Gaussians of {coefficients} SH coefficients")
    afford(4 * count * (14 + 3 * coefficients), size)


def joined(parts: Sequence[Mapping[str, Tensor]], size: int) -> dict[str, Tensor]:
    """The Gaussians of all parts of a file of ``size`` bytes, by :func:`concatenated`; ``ValueError`` for none."""
    most = max((part["features_rest"].shape[1] for part in parts), default=0)
    afford_gaussians(sum(map(num_gaussians, parts)), most, size)
    return concatenated(parts) if len(parts) > 1 else dict(parts[0])


def read_exactly(stream: IO[bytes] | BufferedIOBase, size: int) -> bytes:
    """The next ``size`` bytes of a stream that decompresses; ``ValueError`` if it ends before."""
    content = stream.read(size)
    if len(content) < size:
        raise ValueError(f"{size - len(content):,} bytes are missing")
    return content


def parsed_json(content: bytes) -> Any:
    """A JSON object of a file; ``ValueError`` for other values, and for more than 8 MiB, which take 200."""
    if len(content) > _MOST_JSON:
        raise ValueError(f"its JSON has {len(content):,} bytes, and may have {_MOST_JSON:,}")
    value = json.loads(content)
    if not isinstance(value, dict):
        raise ValueError("its JSON is no object")
    return value
