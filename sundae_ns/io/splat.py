"""Scenes of other viewers and trainers, which are read only: .splat, .ksplat, and the checkpoints of gsplat.

.splat, of the first web viewers, 32 bytes a Gaussian without a header:

    means 3 f4 | widths 3 f4 | red green blue opacity u1 | quaternion wxyz, 128 + 128 q, u1

.ksplat, of GaussianSplats3D, version 0.1, little-endian; read from files of its own converter:

    0     header of 4,096 bytes: u1 major, u1 minor, 2 x, u4 sections stored and used, u4 Gaussians stored and used,
          u2 level, 2 x, 12 x, f4 bounds of SH coefficients
    4096  1,024 bytes a section: u4 Gaussians used and stored, u4 bucket size, u4 buckets, f4 bucket width,
          u2 bytes of a centre, 2 x, u4 range of a coordinate, u4 bytes, u4 full and partial buckets, u2 SH degree
    ...   the sections: u4 lengths of the partial buckets, 3 f4 centres of all buckets, Gaussians bucket after bucket

    level 0: float32, no buckets; 1: positions u2 around the centre of their bucket, all else f2; 2: as 1, SH in u1.
    A Gaussian: means 3, widths 3, quaternion wxyz 4, rgba u1, SH by degree and channel; degrees end at 2.

.pt of gsplat's ``simple_trainer.py``: an archive of ``torch.save`` with ``splats``, one for each rank.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.core.errors import reading, regular
from sundae_ns.core.gaussians import SPLAT_NAMES, odd_shapes, rgb_to_sh
from sundae_ns.io.checkpoint import damage_of, load_tensors
from sundae_ns.io.ply import LEAST_OPACITY

_SPLAT = np.dtype([("means", "<f4", 3), ("widths", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_HEADER, _HEADER_BYTES = struct.Struct("<BBxxIIIIHxx12x2f"), 4096
_SECTION, _SECTION_BYTES = struct.Struct("<IIIIfHxxIIIIH"), 1024
_SH_DTYPES = ("<f4", "<f2", "u1")  # by level
_GSPLAT_NAMES = {name: name for name in SPLAT_NAMES} | {"features_dc": "sh0", "features_rest": "shN"}


def _gaussians(rows: NDArray[Any], means: NDArray[Any], quats: NDArray[Any], rest: NDArray[Any]) -> dict[str, Tensor]:
    """Gaussians of rows with ``widths`` and ``rgba``."""
    arrays = {"means": means, "scales": rows["widths"], "quats": quats, "features_rest": rest}
    params = {name: torch.from_numpy(np.array(values, np.float32, order="C")) for name, values in arrays.items()}
    colors = torch.from_numpy(rows["rgba"] / np.float32(255))
    params["scales"] = params["scales"].log()
    params["features_dc"] = rgb_to_sh(colors[:, :3])
    params["opacities"] = torch.logit(colors[:, 3:], eps=LEAST_OPACITY)
    return params


def _joined(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """The Gaussians of all parts; ``ValueError`` if there are none, or if they differ in their SH degree."""
    parts = [part for part in parts if len(part["means"])]
    if not parts:
        raise ValueError("it has no Gaussians")
    if len({part["features_rest"].shape[1:] for part in parts}) > 1:
        raise ValueError("its sections or ranks have different SH degrees")
    return {name: torch.cat([part[name] for part in parts]) for name in SPLAT_NAMES}


def read_splat(path: Path) -> dict[str, Tensor]:
    """Read a .splat, which has no view-dependent colours.

    Returns:
        Gaussians by the names of :data:`sundae_ns.core.gaussians.SPLAT_NAMES`, float32 on the CPU, in the file's
        coordinates. Log-scales of widths of 0 are infinite; see ``gaussians.sanitise``.

    Raises:
        DataError: the file is missing or empty, or has no whole number of Gaussians.
    """
    with reading(path, "a complete .splat"):
        size = regular(path).stat().st_size
        if size == 0 or size % _SPLAT.itemsize:
            raise ValueError(f"{size:,} bytes are no whole number of Gaussians of {_SPLAT.itemsize} bytes")
        rows = np.fromfile(path, _SPLAT)
    quats = (rows["quats"].astype(np.float32) - 128) / 128
    return _gaussians(rows, rows["means"], quats, np.zeros((len(rows), 0, 3)))


def read_ksplat(path: Path) -> dict[str, Tensor]:
    """Read a .ksplat of any level of compression; the result is as that of :func:`read_splat`.

    Raises:
        DataError: the file is missing, cut or damaged, of another version, or its sections have different SH degrees.
    """
    with reading(path, "a complete .ksplat", remedy="export it again, or convert it to .ply with splat-transform"):
        data = memoryview(regular(path).read_bytes())
        if len(data) < _HEADER_BYTES:
            raise ValueError(f"{len(data):,} bytes are shorter than its header")
        major, minor, stored, used, _, _, level, low, high = _HEADER.unpack_from(data)
        if (major, minor) != (0, 1):
            raise ValueError(f"version {major}.{minor} of the format, not 0.1")
        if level >= len(_SH_DTYPES):
            raise ValueError(f"level {level} of compression, not 0, 1 or 2")
        start = _HEADER_BYTES + stored * _SECTION_BYTES
        if used > stored or start > len(data):
            raise ValueError(f"its {len(data):,} bytes cannot hold {max(used, stored):,} sections")
        bounds = (low or -1.5, high or 1.5)  # of SH coefficients in 8 bits; its own viewer takes 0 for none
        parts = []
        for i in range(used):
            part, start = _section(data, _HEADER_BYTES + i * _SECTION_BYTES, start, level, bounds)
            parts.append(part)
        return _joined(parts)


def _section(
    data: memoryview, header: int, start: int, level: int, bounds: tuple[float, float]
) -> tuple[dict[str, Tensor], int]:
    """The Gaussians of a section with its header and its data at these offsets; and the offset of the next one."""
    fields = _SECTION.unpack_from(data, header)
    used, stored, size, buckets, width, center_bytes, limit, _, full, partial, degree = fields
    if degree > 2:
        raise ValueError(f"SH degree {degree}; the format ends at 2")
    number, coefficients = "<f2" if level else "<f4", (degree + 1) ** 2 - 1
    columns = [("means", "<u2" if level else "<f4", 3), ("widths", number, 3), ("quats", number, 4), ("rgba", "u1", 4)]
    kind = np.dtype([*columns, ("harmonics", _SH_DTYPES[level], 3 * coefficients)])
    centers = start + 4 * partial
    first = centers + center_bytes * buckets
    end = first + stored * kind.itemsize
    if used > stored or end > len(data):
        raise ValueError(f"its {len(data):,} bytes cannot hold a section of {max(used, stored):,} Gaussians")
    rows = np.frombuffer(data, kind, used, first)
    means, harmonics = rows["means"], rows["harmonics"].astype(np.float32)
    if level:
        if center_bytes != 12 or full + partial != buckets:
            raise ValueError("its buckets do not fit together")
        lengths = np.frombuffer(data, "<u4", partial, start)
        # Sums before arrays: a number of rows may be absurd.
        if full * size + int(lengths.sum(dtype=np.uint64)) != stored:
            raise ValueError(f"its buckets do not hold {stored:,} Gaussians")
        bucket = np.repeat(np.arange(buckets), np.concatenate([np.full(full, size, np.int64), lengths]))[:used]
        limit = limit or 32767
        middle = np.frombuffer(data, "<f4", 3 * buckets, centers).reshape(-1, 3)[bucket]
        means = (means.astype(np.float64) - limit) * (width / 2 / limit) + middle
    if level == 2:
        low, high = bounds
        harmonics = low + harmonics / 255 * (high - low)
    degrees = range(1, math.isqrt(coefficients + 1))
    groups = [harmonics[:, 3 * (d * d - 1) : 3 * ((d + 1) ** 2 - 1)].reshape(-1, 3, 2 * d + 1) for d in degrees]
    rest = np.concatenate([np.zeros((len(rows), 3, 0), np.float32), *groups], axis=2).transpose(0, 2, 1)
    return _gaussians(rows, means, rows["quats"], rest), end


def read_gsplat(path: Path) -> dict[str, Tensor]:
    """Read a checkpoint of gsplat's trainer, with those of the other ranks beside it. No code in it runs.

    Training on several GPUs spreads the Gaussians over ``ckpt_29999_rank0.pt``, ``_rank1`` and so on. The result is as
    that of :func:`read_splat`, in the coordinates of gsplat's training.

    Raises:
        DataError: a file is missing or damaged, or holds no Gaussians with SH colours.
    """
    ranks = []
    if match := re.fullmatch(r"(.*_rank)\d+", path.stem):
        name = re.compile(re.escape(match[1]) + r"\d+")
        ranks = sorted(file for file in path.parent.glob("*.pt") if name.fullmatch(file.stem))
    with reading(path, "a checkpoint of gsplat", remedy="give another file"):
        return _joined([_rank(file) for file in ranks or [path]])


def _rank(path: Path) -> dict[str, Tensor]:
    """The Gaussians of one file."""
    with reading(path, "a checkpoint of gsplat", remedy="give another file"), regular(path).open("rb") as file:
        if (damage := damage_of(file)) is not None:
            raise ValueError(damage)
        loaded = load_tensors(file)
        splats = loaded.get("splats") if isinstance(loaded, dict) else None
        if not isinstance(splats, Mapping):
            raise ValueError("it holds no splats")
        missing = [name for name in _GSPLAT_NAMES.values() if not isinstance(splats.get(name), Tensor)]
        if missing and isinstance(splats.get("colors"), Tensor):
            raise ValueError("its colours need a network (app_opt); train with SH colours")
        if missing:
            raise ValueError(f"its splats lack {', '.join(missing)}")
        gaussians = {ours: splats[theirs].detach().float() for ours, theirs in _GSPLAT_NAMES.items()}
        gaussians["features_dc"] = gaussians["features_dc"].flatten(1)
        gaussians["opacities"] = gaussians["opacities"].reshape(-1, 1)
        for odd in odd_shapes(gaussians):
            raise ValueError(odd)
    return gaussians
