"""The .ksplat of GaussianSplats3D, version 0.1; written from the layout of the files of its own converter.

A header of 4,096 bytes, a header of 1,024 bytes for each section, then the sections: the lengths of the last buckets,
the centres of all buckets, and the primitives, bucket after bucket. There are three levels of compression:

- 0: float32, no buckets;
- 1: positions in 16 bits around the centre of their bucket, all else in half precision;
- 2: as 1, with SH coefficients in 8 bits between bounds that the header states.

Base colours and opacities have 8 bits at all levels. SH degrees end at 2.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.errors import reading, regular
from sundae_ns.gaussians.parameters import rgb_to_sh
from sundae_ns.storage.compressed_ply import LEAST_OPACITY

MAX_SH_DEGREE = 2
"""Highest SH degree of a .ksplat."""
# Version; sections and primitives, each as stored and as used; level; the centre of the scene; bounds of harmonics.
_HEADER, _HEADER_BYTES = struct.Struct("<BBxxIIIIHxx12x2f"), 4096
# Primitives used and stored; size, number and width of buckets; bytes of a centre; range of a coordinate; bytes of the
# section; full and other buckets; SH degree.
_SECTION, _SECTION_BYTES = struct.Struct("<IIIIfHxxIIIIH"), 1024
_VERSION = (0, 1)
_CENTER_BYTES = 12
_RANGE = 32767  # of a coordinate in 16 bits, if a section states none
_BOUND = 1.5  # of SH coefficients in 8 bits, if the header states none
_HARMONICS = {0: "<f4", 1: "<f2", 2: "u1"}


class _Header(NamedTuple):
    """What the header of a file says of all sections."""

    sections: int
    level: int
    low: float
    high: float


def read_ksplat(path: Path) -> dict[str, Tensor]:
    """Read a .ksplat of any level of compression.

    Returns:
        A field by the names of :data:`sundae_ns.gaussians.parameters.SPLAT_NAMES`, float32 on the CPU, in the file's
        coordinates. Log-scales of widths of 0 are infinite; see ``gaussians.mend``.

    Raises:
        DataError: the file is missing, cut or damaged, of another version, or its sections have different SH degrees.
    """
    with reading(path, "a complete .ksplat", mend="export it again, or convert it to .ply with splat-transform"):
        data = memoryview(regular(path).read_bytes())
        header, start = _header(data)
        parts = []
        for i in range(header.sections):
            part, start = _section(data, _HEADER_BYTES + i * _SECTION_BYTES, start, header)
            parts += [part] if len(part["means"]) else []
        if not parts:
            raise ValueError("it has no primitives")
        if any(part["features_rest"].shape[1] != parts[0]["features_rest"].shape[1] for part in parts):
            raise ValueError("its sections have different SH degrees")
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _header(data: memoryview) -> tuple[_Header, int]:
    """The header of a file, and where its first section begins."""
    if len(data) < _HEADER_BYTES:
        raise ValueError(f"{len(data):,} bytes are shorter than its header")
    major, minor, stored, used, _, _, level, low, high = _HEADER.unpack_from(data)
    if (major, minor) != _VERSION:
        raise ValueError(f"version {major}.{minor} of the format, not 0.1")
    if level not in _HARMONICS:
        raise ValueError(f"level {level} of compression, not 0, 1 or 2")
    start = _HEADER_BYTES + stored * _SECTION_BYTES
    if used > stored or start > len(data):
        raise ValueError(f"its {len(data):,} bytes cannot hold {max(used, stored):,} sections")
    # Like its own viewer, which takes a bound of 0 for none.
    return _Header(used, level, low or -_BOUND, high or _BOUND), start


def _section(data: memoryview, place: int, start: int, header: _Header) -> tuple[dict[str, Tensor], int]:
    """The field of a section with its header at ``place`` and its data at ``start``; and where the next one begins."""
    found = _SECTION.unpack_from(data, place)
    used, stored, size, buckets, width, center_bytes, limit, _, full, partial, degree = found
    if degree > MAX_SH_DEGREE:
        raise ValueError(f"SH degree {degree}; the format ends at {MAX_SH_DEGREE}")
    kind = _row(header.level, (degree + 1) ** 2 - 1)
    centers = start + 4 * partial
    first = centers + center_bytes * buckets
    end = first + stored * kind.itemsize
    if used > stored or end > len(data):
        raise ValueError(f"its {len(data):,} bytes cannot hold a section of {max(used, stored):,} primitives")
    rows = np.frombuffer(data, kind, used, first)
    means = rows["means"]
    if header.level:
        if center_bytes != _CENTER_BYTES or full + partial != buckets:
            raise ValueError("its buckets do not fit together")
        lasts = np.frombuffer(data, "<u4", partial, start)
        # Sums before arrays: a number of rows may be absurd.
        if full * size + int(lasts.sum(dtype=np.uint64)) != stored:
            raise ValueError(f"its buckets do not hold {stored:,} primitives")
        bucket = np.repeat(np.arange(buckets), np.concatenate([np.full(full, size, np.int64), lasts]))[:used]
        limit = limit or _RANGE
        middle = np.frombuffer(data, "<f4", 3 * buckets, centers).reshape(-1, 3)[bucket]
        means = (means.astype(np.float64) - limit) * (width / 2 / limit) + middle
    return _field(rows, means, header), end


def _row(level: int, coefficients: int) -> np.dtype[Any]:
    """A primitive in the file; SH coefficients are in the groups of their degree, channel by channel."""
    number = "<f2" if level else "<f4"
    parts = [("means", "<u2" if level else "<f4", 3), ("widths", number, 3), ("quats", number, 4), ("rgba", "u1", 4)]
    return np.dtype([*parts, ("harmonics", _HARMONICS[level], 3 * coefficients)])


def _field(rows: NDArray[Any], means: NDArray[Any], header: _Header) -> dict[str, Tensor]:
    harmonics = rows["harmonics"].astype(np.float32)
    if header.level == 2:
        harmonics = header.low + harmonics / 255 * (header.high - header.low)
    degrees = range(1, math.isqrt(harmonics.shape[1] // 3 + 1))
    groups = [harmonics[:, 3 * (d * d - 1) : 3 * ((d + 1) ** 2 - 1)].reshape(-1, 3, 2 * d + 1) for d in degrees]
    rest = np.concatenate([np.zeros((len(rows), 3, 0), np.float32), *groups], axis=2).transpose(0, 2, 1)
    colors = torch.from_numpy(rows["rgba"] / np.float32(255))

    def tensor(values: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.array(values, np.float32))

    return {
        "means": tensor(means),
        "scales": tensor(rows["widths"]).log(),
        "quats": tensor(rows["quats"]),
        "features_dc": rgb_to_sh(colors[:, :3]),
        "features_rest": tensor(rest).contiguous(),
        "opacities": torch.logit(colors[:, 3:], eps=LEAST_OPACITY),
    }
