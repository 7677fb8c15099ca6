"""The .spz of Niantic: quantised, deflated Gaussians, which most web viewers read; coded by ``gsply``.

One gzip stream (versions 1 to 3), little-endian; version 4 starts with the header itself:

    16 bytes  "NGSP", u4 version, u4 count, u1 SH degree, u1 fractional bits, u1 flags (1: antialiased), u1 reserved
    9 N       positions, fixed point in 24 bits
    N         opacities, 256 levels after activation
    3 N       SH coefficients of degree 0, steps of 1/38
    3 N       log-scales, steps of 1/16 within [-10, 5.94]
    4 N       rotations: the three smallest components, 9 bits and a sign each
    3 K N     SH coefficients of degrees 1 to 3, steps of 1/128 within [-1, 1]; higher degrees do not fit

The specification asks for right-up-back axes, but its own converter from .ply does not rotate, nor do ``gsply`` and
``splat-transform`` (nianticlabs/spz, issue 84). Neither does this module: a .ply and a .spz show the same scene.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sundae_ns.core.errors import DataError, reading, regular
from sundae_ns.core.files import replacing
from sundae_ns.io.ply import checked

_HARMONICS_STEP = 1 / 64  # costs 0.03 dB; twice this step costs 0.12 dB (docs/formats.md)
_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, reserved


def fractional_bits(means: Tensor) -> int:
    """Most fractional bits, at most 24, of positions ``[N, 3]`` with which the farthest Gaussian fits.

    The error of a coordinate is at most ``2^-(bits + 1)``, plus the rounding of float32.

    Raises:
        DataError: a Gaussian is so far away that fewer than 8 bits are left.
    """
    farthest = float(means.abs().max())
    for bits in range(24, 7, -1):
        if round(farthest * 2**bits) < 1 << 23:  # a coordinate has 24 bits with its sign
            return bits
    raise DataError(
        f"a Gaussian is {farthest:.3g} from the origin, too far for the fixed point of a .spz; write a .sog or .ply"
    )


def write_spz(path: Path, params: Mapping[str, Tensor], *, antialiased: bool = False) -> None:
    """Write the base colours of finite Gaussians of SH degree at most 3 as a .spz, atomically.

    Raises:
        DataError: there are no Gaussians, an SH degree above 3, a Gaussian too far away, or wrong shapes.
        StorageError: the disk is full or not writable.
    """
    from gsply import GSData
    from gsply.spz import write_spz as write

    gaussians = checked(path, params)
    bits = fractional_bits(gaussians["means"])
    gaussians["features_rest"] = (gaussians["features_rest"] / _HARMONICS_STEP).round() * _HARMONICS_STEP
    names = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")
    means, scales, quats, opacities, colors, rest = (gaussians[name].numpy() for name in names)
    harmonics = rest if rest.size else None
    data = GSData.from_arrays(means, scales, quats, opacities[:, 0], colors, harmonics, format="ply")
    with replacing(path) as partial:
        write(partial, data, version=3, fractional_bits=bits)  # more programs read version 3 than 4
        # gsply 0.4 has no option for the flag of antialiasing, in byte 14.
        raw = bytearray(gzip.decompress(partial.read_bytes()))
        raw[14] |= antialiased
        partial.write_bytes(gzip.compress(bytes(raw), mtime=0))


def read_spz(path: Path) -> tuple[dict[str, Tensor], bool]:
    """Read a .spz of version 1 to 4: Gaussians as of ``ply.read_ply``, and whether they are marked as antialiased.

    Raises:
        DataError: the file is missing, damaged, no .spz, or unpacks to far more than its size.
    """
    from gsply.spz import read_spz as read

    with reading(path, "a complete .spz"):
        flags = _checked_flags(path)
        data = read(path)
    n = len(data.means)
    rest = data.shN if data.shN is not None and data.shN.size else np.zeros((n, 0, 3))
    columns = {
        "means": data.means,
        "scales": data.scales,
        "quats": data.quats,
        "features_dc": data.sh0.reshape(n, 3),
        "features_rest": rest.reshape(n, -1, 3),
        "opacities": data.opacities.reshape(n, 1),
    }
    gaussians = {name: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for name, value in columns.items()}
    return gaussians, bool(flags & 1)


def _checked_flags(path: Path) -> int:
    """Flags of a .spz. gsply unpacks without a limit, so this checks the size before."""
    raw = regular(path).read_bytes()
    most = (8 << 20) + 64 * len(raw)
    packed = raw[:2] == b"\x1f\x8b"
    header = zlib.decompressobj(wbits=31).decompress(raw, _HEADER.size) if packed else raw[: _HEADER.size]
    if len(header) < _HEADER.size or header[:4] != b"NGSP":
        raise DataError(f"{path} is no .spz; give a .ply, .spz, .sog, .sundae, or a run")
    _, _, count, _, _, flags, _ = _HEADER.unpack(header)
    if count == 0 or count * 19 > most:  # bytes of a Gaussian of SH degree 0
        raise DataError(f"{path} states {count:,} Gaussians, which its {len(raw):,} bytes cannot hold; export it again")
    if packed:
        stream, rest, size = zlib.decompressobj(wbits=31), raw, 0
        while rest and not stream.eof:
            size += len(stream.decompress(rest, 1 << 20))
            rest = stream.unconsumed_tail
            if size > most:
                raise DataError(f"{path} unpacks to far more than its {len(raw):,} bytes; export it again")
    return int(flags)


def clamped(gaussians: Mapping[str, Tensor]) -> int:
    """Number of Gaussians with a scale or an SH coefficient beyond what a .spz stores; it stores the nearest value."""
    beyond = ((gaussians["scales"] < -10) | (gaussians["scales"] > 5.9375)).any(dim=1)
    beyond |= (gaussians["features_dc"].abs() > 0.5 / 0.15).any(dim=1)
    beyond |= (gaussians["features_rest"].flatten(1).abs() > 1).any(dim=1)
    return int(beyond.sum())
