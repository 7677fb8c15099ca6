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
from sundae_ns.core.gaussians import SPLAT_NAMES, rgb_to_sh
from sundae_ns.io.budget import joined
from sundae_ns.io.checkpoint import check_whole, load_tensors
from sundae_ns.io.ply import LEAST_OPACITY, UNMARKED, Marks, check_gaussians

_SPLAT = np.dtype([("means", "<f4", 3), ("widths", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_HEADER, _HEADER_BYTES = struct.Struct("<BBxxIIIIHxx12x2f"), 4096
_SECTION, _SECTION_BYTES = struct.Struct("<IIIIfHxxIIIIH"), 1024
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


def read_splat(path: Path) -> tuple[dict[str, Tensor], Marks]:
    """Read a .splat, which has no view-dependent colours; ``DataError`` if it has no whole number of Gaussians.

    Gaussians have the names of :data:`sundae_ns.core.gaussians.SPLAT_NAMES`, float32 on the CPU, in the file's
    coordinates; such files state nothing of them. Log-scales of widths of 0 are infinite; see ``gaussians.sanitise``.
    """
    with reading(path, "a complete .splat"):
        content = regular(path).read_bytes()
        rows = np.frombuffer(content, _SPLAT)
        begin = content[: 1 << 16]
        if (begin and begin.decode(errors="ignore").encode() == begin) or (rows["widths"] < 0).any():
            raise ValueError("it is text, or has negative widths")
    quats = (rows["quats"].astype(np.float32) - 128) / 128
    return _gaussians(rows, rows["means"], quats, np.zeros((len(rows), 0, 3))), UNMARKED


def read_ksplat(path: Path) -> tuple[dict[str, Tensor], Marks]:
    """As :func:`read_splat`, a .ksplat of any level; ``DataError`` for other versions, or sections of other degrees."""
    with reading(path, "a complete .ksplat", remedy="export it again, or convert it to .ply with splat-transform"):
        data = memoryview(regular(path).read_bytes())
        major, minor, stored, used, _, _, level, low, high = _HEADER.unpack_from(data)
        if (major, minor) != (0, 1) or level > 2 or used > stored:
            raise ValueError(f"version {major}.{minor}, level {level}, not version 0.1 of level 0, 1 or 2")
        start = _HEADER_BYTES + stored * _SECTION_BYTES
        parts: list[dict[str, Tensor]] = []
        for i in range(used):
            section = _SECTION.unpack_from(data, _HEADER_BYTES + i * _SECTION_BYTES)
            part, start = _section(data, start, level, (low or -1.5, high or 1.5), section)
            parts.append(part)
        return joined(parts, len(data)), UNMARKED


def _section(
    data: memoryview, start: int, level: int, bounds: tuple[float, float], section: tuple[Any, ...]
) -> tuple[dict[str, Tensor], int]:
    """The Gaussians of a section whose data start at an offset; and the offset of the next one."""
    used, stored, size, buckets, width, center_bytes, limit, _, full, partial, degree = section
    if used > stored or degree > 2 or (level and (center_bytes != 12 or full + partial != buckets)):
        raise ValueError("a section's SH degree, Gaussians and buckets do not fit together")
    real = "<f2" if level else "<f4"
    columns = [("means", "<u2" if level else "<f4", 3), ("widths", real, 3), ("quats", real, 4), ("rgba", "u1", 4)]
    kind = np.dtype([*columns, ("harmonics", ("<f4", "<f2", "u1")[level], 3 * ((degree + 1) ** 2 - 1))])
    centers = start + 4 * partial
    first = centers + center_bytes * buckets
    # numpy refuses what reaches beyond the file, before larger arrays are made of it.
    rows = np.frombuffer(data, kind, stored, first)[:used]
    means, harmonics = rows["means"], rows["harmonics"].astype(np.float32)
    if level:
        lengths = np.frombuffer(data, "<u4", partial, start)
        if full * size + int(lengths.sum(dtype=np.uint64)) != stored:
            raise ValueError(f"its buckets do not hold {stored:,} Gaussians")
        middles = np.frombuffer(data, "<f4", 3 * buckets, centers).reshape(-1, 3)
        middles = np.repeat(middles, np.concatenate([np.full(full, size, np.int64), lengths]), axis=0)[:used]
        limit = limit or 32767  # of its own viewer, as are bounds of SH coefficients where it has 0
        means = (means.astype(np.float64) - limit) * (width / 2 / limit) + middles
    if level == 2:
        harmonics = bounds[0] + harmonics / 255 * (bounds[1] - bounds[0])
    degrees = range(1, degree + 1)
    groups = [harmonics[:, 3 * (d * d - 1) : 3 * ((d + 1) ** 2 - 1)].reshape(-1, 3, 2 * d + 1) for d in degrees]
    rest = np.concatenate([np.zeros((len(rows), 3, 0), np.float32), *groups], axis=2).transpose(0, 2, 1)
    return _gaussians(rows, means, rows["quats"], rest), first + stored * kind.itemsize


def rank_files(path: Path) -> list[Path]:
    """Files of a checkpoint of gsplat: several GPUs write ``ckpt_29999_rank0.pt``, ``_rank1`` and so on."""
    if (match := re.fullmatch(r"(.*_rank)\d+", path.stem)) is None:
        return [path]
    name = re.compile(re.escape(match[1]) + r"\d+")
    return sorted(file for file in path.parent.glob("*.pt") if name.fullmatch(file.stem)) or [path]


def read_gsplat(path: Path) -> tuple[dict[str, Tensor], Marks]:
    """As :func:`read_splat`, a checkpoint of gsplat's trainer, of all its ranks. No code in it runs."""
    parts = []
    for each in rank_files(path):
        with reading(each, "a checkpoint of gsplat", remedy="give another file"), regular(each).open("rb") as file:
            check_whole(file)
            parts.append(_trained(load_tensors(file)))
    with reading(path, "a checkpoint of gsplat", remedy="give another file"):
        return joined(parts, sum(each.stat().st_size for each in rank_files(path))), UNMARKED


def _trained(loaded: Any) -> dict[str, Tensor]:
    splats = loaded.get("splats") if isinstance(loaded, dict) else None
    if not isinstance(splats, Mapping):
        raise ValueError("it holds no splats")
    given = {name: value for name, value in splats.items() if isinstance(value, Tensor) and value.is_floating_point()}
    missing = [name for name in _GSPLAT_NAMES.values() if name not in given]
    if missing and isinstance(splats.get("colors"), Tensor):
        raise ValueError("its colours need a network (app_opt); train with SH colours")
    if missing:
        raise ValueError(f"its splats lack {', '.join(missing)}, or they are no floating-point numbers")
    gaussians = {ours: given[theirs].detach().float() for ours, theirs in _GSPLAT_NAMES.items()}
    gaussians["means"] = given["means"].detach().double()  # for survey coordinates
    gaussians["features_dc"] = gaussians["features_dc"].flatten(1)
    gaussians["opacities"] = gaussians["opacities"].reshape(-1, 1)
    check_gaussians(gaussians, ValueError)
    return gaussians
