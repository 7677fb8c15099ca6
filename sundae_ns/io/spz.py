"""The .spz of Niantic: quantised, compressed Gaussians, which most web viewers read; ``gsply`` writes them.

One gzip stream (versions 1 to 3), little-endian:

    16 bytes  "NGSP", u4 version, u4 count, u1 SH degree, u1 fractional bits, u1 flags (1: antialiased), u1 reserved
    9 N       positions, fixed point in 24 bits; version 1: 6 N, f2
    N         opacities, 256 levels after activation
    3 N       SH coefficients of degree 0, steps of 1/38
    3 N       log-scales, steps of 1/16 within [-10, 5.94]
    4 N       rotations: the three smallest components, 9 bits and a sign each; before version 3: x, y, z in 3 N
    3 K N     SH coefficients of degrees 1 to 4, steps of 1/128 within [-1, 1]
    ...       extensions, if flags have 2: u4 type, u4 bytes, content

Version 4 starts with the header, where u1 reserved is the number of streams: u4 offset of the table, 12 x, extensions;
table of u8 bytes stored and unpacked; the same parts, a zstd frame each.

The specification asks for right-up-back axes, but its own converter from .ply does not rotate, nor do ``gsply`` and
``splat-transform`` (nianticlabs/spz, issue 84). So a .ply and a .spz show the same scene, unless the file states its
axes (extension ADBE0003): these are turned to those of a .ply, right-down-front. Up and an offset, which have no field,
stand in the comment of the gzip stream, as in a .ply.
"""

from __future__ import annotations

import gzip
import io
import logging
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.core.files import replacing
from sundae_ns.core.gaussians import SPLAT_NAMES
from sundae_ns.io.budget import afford_gaussians, read_exactly
from sundae_ns.io.coordinates import similarity
from sundae_ns.io.ply import LEAST_OPACITY, UNMARKED, Marks, checked, comments_of, from_smallest_three, marks_in

_AXES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LBD", "RBD", "LBU", "RBU", "LFD", "RFD", "LFU", "RFU")
_OPPOSITE = dict(zip("LRDUBF", "RLUDFB", strict=True))
_COORDINATE_SYSTEM = 0xADBE0003
_COMMENTED = b"\x1f\x8b\x08\x10"  # the begin of a gzip stream with a comment
_HARMONICS_STEP = 1 / 64  # costs 0.03 dB; twice this step costs 0.12 dB (docs/formats.md)
_RANGES = {"scales": (-10, 5.9375), "features_dc": (-0.5 / 0.15, 0.5 / 0.15), "features_rest": (-1, 1)}  # stored values
_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, reserved
_log = logging.getLogger(__name__)


def fractional_bits(means: Tensor) -> int:
    """Most fractional bits, 8 to 24, with which the farthest of positions ``[N, 3]`` fits; ``DataError`` if none does.

    The error of a coordinate is at most ``2^-(bits + 1)``, plus the rounding of float32.
    """
    farthest = float(means.abs().max())
    for bits in range(24, 7, -1):
        if round(farthest * 2**bits) < 1 << 23:  # a coordinate has 24 bits with its sign
            return bits
    raise DataError(f"a Gaussian is {farthest:.3g} from the origin, too far for a .spz; write a .sog or .ply")


def write_spz(path: Path, params: Mapping[str, Tensor], marks: Marks = UNMARKED) -> None:
    """Write the base colours of Gaussians that ``ply.checked`` accepts as a .spz, atomically."""
    from gsply import GSData
    from gsply.spz import write_spz as write

    gaussians = checked(path, params)
    bits = fractional_bits(gaussians["means"])
    over = {name: (gaussians[name] - gaussians[name].clamp(*ends)).flatten(1).abs() for name, ends in _RANGES.items()}
    if beyond := int(torch.cat([*over.values()], dim=1).any(dim=1).sum()):
        most = ", ".join(f"{name} by up to {value.max():.3g}" for name, value in over.items() if value.any())
        _log.warning("%s clamps %s Gaussians to what a .spz stores: %s; a .sog has no such limits", path, beyond, most)
    gaussians["features_rest"] = (gaussians["features_rest"] / _HARMONICS_STEP).round() * _HARMONICS_STEP
    means, scales, quats, colors, rest, opacities = (gaussians[name].numpy() for name in SPLAT_NAMES)
    data = GSData.from_arrays(means, scales, quats, opacities[:, 0], colors, rest if rest.size else None, format="ply")
    with replacing(path) as partial:
        # More programs read version 3 than 4, but gsply 0.4 packs 4 faster, and has no option for flags.
        write(partial, data, version=4, fractional_bits=bits, zstd_level=1)
        content = partial.read_bytes()
        sizes = [unpacked for _, unpacked in struct.iter_unpack("<QQ", content[32 : 32 + 16 * content[15]])]
        header = _HEADER.pack(b"NGSP", 3, len(means), content[12], bits, marks.antialiased, 0)
        packed = gzip.compress(header + b"".join(_streams(content, sizes)[0]), mtime=0)
        comments = "\n".join(comments_of(marks)).encode()
        partial.write_bytes(_COMMENTED + packed[4:10] + comments + b"\0" + packed[10:])


def read_spz(path: Path) -> tuple[dict[str, Tensor], Marks]:
    """Read a .spz of version 1 to 4: Gaussians as of ``ply.read_ply``, and what it states of them."""
    with reading(path, "a complete .spz"):
        content = regular(path).read_bytes()
        params, marks = decoded(content, "RDF")
        comment = content[10 : content.find(b"\0", 10, 1024)] if content.startswith(_COMMENTED) else b""
        return params, marks_in(comment.decode("latin-1").splitlines())._replace(antialiased=marks.antialiased)


def decoded(content: bytes, axes: str) -> tuple[dict[str, Tensor], Marks]:
    """As :func:`read_spz`, of the bytes of a file, in these axes if it states its own. Raises many kinds of errors."""
    packed = content[:2] == b"\x1f\x8b"
    stream = io.BytesIO(content) if not packed else gzip.GzipFile(fileobj=io.BytesIO(content))
    magic, version, n, degree, bits, flags, _ = _HEADER.unpack(read_exactly(stream, _HEADER.size))
    if magic != b"NGSP" or version not in ((1, 2, 3) if packed else (1, 2, 3, 4)) or bits > 24 or flags > 3:
        raise ValueError(f"its header, {magic!r} {version} {flags}, is not that of version 1 to 4; gunzip other files")
    coefficients = (degree + 1) ** 2 - 1
    afford_gaussians(n, coefficients, len(content))
    widths = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * coefficients)
    if version < 4:
        parts = [read_exactly(stream, n * width) for width in widths]
        extensions = stream.read(1 << 16)
        if stream.read(1) or (extensions and not flags & 2):  # at the end it has compared the checksum
            raise ValueError("it unpacks to more than its header states")
    else:
        parts, extensions = _streams(content, [n * width for width in widths if width])
    positions, alphas, colors, scales, rotations, harmonics = (
        np.frombuffer(part, np.uint8).reshape(n, width) for part, width in zip([*parts, b""], widths, strict=False)
    )
    if version == 1:
        means = positions.view("<f2").astype(np.float32)
    else:
        words = np.zeros((n, 3, 4), np.uint8)
        words[..., 1:] = positions.reshape(n, 3, 3)  # the sign is in the highest bit
        means = (words.view("<i4")[..., 0] >> 8).astype(np.float32) * np.float32(0.5**bits)
    if version < 3:
        quats = from_smallest_three(rotations / np.float32(127.5) - 1, np.full(n, 3))
    else:
        levels = rotations.view("<u4") >> np.array([20, 10, 0], np.uint32)
        ratios = (levels & 511) / np.float32(511) * np.float32(np.sqrt(0.5))
        quats = from_smallest_three(np.where(levels & 512, -ratios, ratios), rotations.view("<u4")[:, 0] >> 30)
    arrays = {
        "means": means,
        "scales": scales / np.float32(16) - 10,
        "quats": np.roll(quats, 1, axis=1),  # xyzw in the file
        "features_dc": (colors / np.float32(255) - np.float32(0.5)) / np.float32(0.15),
        "features_rest": ((harmonics - np.float32(128)) / 128).reshape(n, coefficients, 3),
    }
    params = {name: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for name, value in arrays.items()}
    params["opacities"] = torch.logit(torch.from_numpy(alphas / np.float32(255)), eps=LEAST_OPACITY)
    if flags & 2 and (stated := _stated_axes(memoryview(extensions), version)):
        turn = [[float((a == b) - (a == _OPPOSITE[b])) for a in stated] for b in axes]
        params = similarity(params, torch.tensor([[*row, 0.0] for row in turn]), 1.0)
    return params, Marks(bool(flags & 1))


def _streams(content: bytes, sizes: list[int]) -> tuple[list[bytes], bytes]:
    """The parts of a file of version 4, which have these sizes, and its extensions."""
    from zstandard import ZstdDecompressor

    number, table = struct.unpack_from("<BI", content, 15)  # of streams, and the offset of their table
    offset = table + 16 * number
    parts: list[bytes] = []
    for i, size in enumerate(sizes):
        stored, unpacked = struct.unpack_from("<QQ", content, table + 16 * i)
        if number != len(sizes) or unpacked != size or offset + stored > len(content):
            raise ValueError("its table of streams does not fit its header")
        # A stream, because a frame may state another size, which is allocated at once.
        with ZstdDecompressor().stream_reader(content[offset : offset + stored]) as stream:
            parts.append(stream.read(size + 1))
        if len(parts[-1]) != size:
            raise ValueError(f"a stream has not the {size:,} bytes that its table states")
        offset += stored
    return parts, content[32:table]


def _stated_axes(extensions: memoryview, version: int) -> str | None:
    """Names of the axes x, y and z by an extension, which numbers them from 1."""
    while version > 3 or len(extensions) >= 8:
        kind, size = struct.unpack_from("<II", extensions)
        content, extensions = extensions[8 : 8 + size], extensions[8 + size :]
        if len(content) < size and (version > 3 or kind == _COORDINATE_SYSTEM):  # the first writers stated no sizes
            raise ValueError(f"its extensions end {size - len(content):,} bytes early")
        if kind == _COORDINATE_SYSTEM and (system := struct.unpack("<I", content)[0]) > 0:
            if system > len(_AXES):
                raise ValueError(f"it states axes number {system}, and known are 1 to {len(_AXES)}")
            return _AXES[system - 1]
        if not extensions:
            break
    return None
