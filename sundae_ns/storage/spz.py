"""The .spz of Niantic: quantised primitives, deflated, which most web viewers read; written by ``gsply``.

What the format itself rounds, of each value before activation unless said otherwise: positions to a fixed point of 24 bits,
log-scales to steps of 1/16 within [-10, 5.94], opacities to 256 levels after activation, colours of band 0 to 1/38, further
bands to 1/128 within [-1, 1], rotations to the smallest three of 9 bits and a sign. There are bands to 3.

The format's text asks for axes right-up-back, but its own converter from .ply does not turn anything, nor do ``gsply`` and
``splat-transform`` (nianticlabs/spz, issue 84). So the numbers here are the .ply's too: both files show the same scene.
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sundae_ns.errors import DataError
from sundae_ns.storage.atomic import replacing
from sundae_ns.storage.ply import check_field

MAX_SH_DEGREE = 3
"""Bands of harmonics that .spz and .sog have places for."""
HARMONICS_STEP = 1 / 64
"""Costs 0.03 dB where the finest step costs 0.01 and the one twice as coarse 0.12; see docs/packing.md."""
_VERSION = 3  # one gzip stream; more programs read it than version 4
_HEADER_FLAGS = 14  # byte of the header
_ANTIALIASED = 0x1  # one of these flags
_LARGEST = (1 << 23) - 1  # coordinate in steps, of 24 bits with a sign
_MOST_BITS = 24  # binary places of a coordinate
_FEWEST_BITS = 8


def fractional_bits(means: Tensor) -> int:
    """Binary places of the positions: as many as let the farthest primitive fit, at most 24.

    The error of a coordinate is at most ``2^-(bits + 1)``, beside float32's own.

    Args:
        means: centres ``[N, 3]``, finite, N at least 1.

    Raises:
        DataError: a primitive is so far away that fewer than 8 places are left for all.
    """
    farthest = float(means.abs().max())
    for bits in range(_MOST_BITS, _FEWEST_BITS - 1, -1):
        if round(farthest * 2**bits) <= _LARGEST:
            return bits
    raise DataError(
        f"a primitive is {farthest:.3g} from the origin, which leaves a .spz too few bits for the others; write a .sog or .ply"
    )


def write_spz(
    path: Path, params: Mapping[str, Tensor], *, antialiased: bool = False, harmonics_step: float = HARMONICS_STEP
) -> None:
    """Write the base colours of a field as a .spz; an existing file is replaced only once the new one is whole.

    Args:
        path: the file; its folder must exist.
        params: a field of finite values and SH degree 3 at most; see :mod:`sundae_ns.gaussians.parameters`. ``features``
            are left out.
        antialiased: set the flag of scenes that were trained with antialiasing.
        harmonics_step: bands 1 and up are rounded to multiples of it, a power of two of at least 1/128, before they are
            written as bytes; coarser steps deflate better.

    Raises:
        DataError: the field has no primitives, what the format cannot hold, or wrong shapes.
        StorageError: the disk is full, or may not be written to.
    """
    from gsply import GSData
    from gsply.spz import write_spz as write

    field = checked(path, params)
    bits = fractional_bits(field["means"])
    field["features_rest"] = (field["features_rest"] / harmonics_step).round() * harmonics_step
    arrays = {name: value.numpy() for name, value in field.items()}
    data = GSData.from_arrays(
        means=arrays["means"],
        scales=arrays["scales"],
        quats=arrays["quats"],
        opacities=arrays["opacities"][:, 0],
        sh0=arrays["features_dc"],
        shN=arrays["features_rest"] if arrays["features_rest"].size else None,
        format="ply",
    )
    with replacing(Path(path)) as partial:
        write(partial, data, version=_VERSION, fractional_bits=bits)
        # gsply 0.4 has no option for the flag.
        raw = bytearray(gzip.decompress(partial.read_bytes()))
        raw[_HEADER_FLAGS] |= _ANTIALIASED * antialiased
        partial.write_bytes(gzip.compress(bytes(raw), mtime=0))


def checked(path: Path, params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What .spz and .sog take of a field: float32 on the CPU, unit quaternions, zero ones turned into no rotation.

    Raises:
        DataError: as :func:`write_spz`.
    """
    check_field(params)
    names = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")
    field = {name: params[name].detach().to(device="cpu", dtype=torch.float32).contiguous() for name in names}
    if not len(field["means"]):
        raise DataError(f"the field has no primitives, and {Path(path).suffix} no way to say so; check the run")
    if not all(bool(value.isfinite().all()) for value in field.values()):
        raise DataError("some values are NaN or infinite; drop those primitives first (finite_mask)")
    if field["features_rest"].shape[1] > (MAX_SH_DEGREE + 1) ** 2 - 1:
        raise DataError(
            f"{Path(path).suffix} holds harmonics to degree {MAX_SH_DEGREE}; cut features_rest, or write a .ply"
        )
    # In float64: squares of 1e-30 are 0 in float32.
    quats = field["quats"].double()
    norms = quats.norm(dim=1, keepdim=True)
    identity = torch.tensor(np.eye(1, 4)[0])
    field["quats"] = torch.where(norms > 0, quats / norms.clamp_min(torch.finfo(torch.float64).tiny), identity).float()
    return field
