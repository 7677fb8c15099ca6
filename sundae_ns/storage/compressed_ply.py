"""The compressed .ply of PlayCanvas (SuperSplat, splat-transform): 16 bytes a primitive, in chunks of 256.

Read from the format's public description. Positions and log-scales have 11, 10 and 11 bits between the bounds of their
chunk; colours and opacities have 8 bits; rotations are the three smaller components in 10 bits each. SH coefficients
have 8 bits in [-4, 4].
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.gaussians.parameters import rgb_to_sh, sh_degree_of

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
"""Properties of the vertices of a compressed .ply."""
LEAST_OPACITY = 1e-6
"""Opacity of a byte of 0, and what one of 255 lacks to 1: their logits stay finite."""
_CHUNK = 256
_HARMONICS_RANGE = 8.0

Rows = NDArray[Any]
"""Rows of an element, a structured array."""


def decompressed(chunks: Rows, vertices: Rows, harmonics: Rows | None) -> dict[str, Tensor]:
    """A field by the names of :data:`sundae_ns.gaussians.parameters.SPLAT_NAMES`, float32 on the CPU.

    Args:
        chunks: bounds; those of colours are 0 and 1 where the file has none.
        vertices: with the properties :data:`PACKED`.
        harmonics: SH coefficients of degrees 1 and up as bytes, channel by channel; None for none.

    Raises:
        ValueError: elements do not fit together.
    """
    n = len(vertices)
    if len(chunks) < -(-n // _CHUNK):
        raise ValueError(f"{len(chunks)} chunks are too few for {n:,} primitives")
    chunk = np.arange(n) // _CHUNK

    def between(shares: NDArray[np.float32], names: str) -> NDArray[np.float32]:
        low, high = (_bounds(chunks, end, names)[chunk] for end in ("min", "max"))
        return low + shares * (high - low)

    color = _shares(vertices["packed_color"], (8, 8, 8, 8))
    rgb = between(color[:, :3], "rgb") if "min_r" in (chunks.dtype.names or ()) else color[:, :3]
    values: dict[str, NDArray[np.float32]] = {
        "means": between(_shares(vertices["packed_position"], (11, 10, 11)), "xyz"),
        "scales": between(_shares(vertices["packed_scale"], (11, 10, 11)), "scale_xyz"),
        "quats": _rotations(vertices["packed_rotation"]),
        "features_dc": rgb,
        "features_rest": _harmonics(harmonics, n),
    }
    field = {name: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for name, value in values.items()}
    field["features_dc"] = rgb_to_sh(field["features_dc"])
    return {**field, "opacities": torch.logit(torch.from_numpy(color[:, 3:].copy()), eps=LEAST_OPACITY)}


def _bounds(chunks: Rows, end: str, names: str) -> NDArray[np.float32]:
    kind, _, axes = names.rpartition("_")
    return np.stack([chunks[f"{end}_{kind}{'_' if kind else ''}{axis}"] for axis in axes], axis=1).astype(np.float32)


def _shares(words: NDArray[Any], bits: tuple[int, ...]) -> NDArray[np.float32]:
    """Fields of 32-bit words, from the top bit down, as shares of their largest value ``[N, len(bits)]``."""
    left, columns = 32, []
    for width in bits:
        left -= width
        most = (1 << width) - 1
        columns.append(((words.astype(np.uint32) >> np.uint32(left)) & np.uint32(most)) / np.float32(most))
    return np.stack(columns, axis=1).astype(np.float32)


def _rotations(words: NDArray[Any]) -> NDArray[np.float32]:
    """Unit quaternions wxyz ``[N, 4]``: the index of the largest component, then the others."""
    others = (_shares(words, (2, 10, 10, 10))[:, 1:] - 0.5) * np.float32(np.sqrt(2))
    largest = (words.astype(np.uint32) >> np.uint32(30)).astype(np.int64)
    quats = np.empty((len(words), 4), np.float32)
    quats[np.arange(4) != largest[:, None]] = others.ravel()
    quats[np.arange(len(words)), largest] = np.sqrt(np.clip(1 - (others**2).sum(axis=1), 0, None))
    return quats


def _harmonics(rows: Rows | None, n: int) -> NDArray[np.float32]:
    """SH coefficients ``[N, K, 3]``."""
    names = [] if rows is None else [name for name in rows.dtype.names or () if name.startswith("f_rest_")]
    if rows is None or not names:
        return np.zeros((n, 0, 3), np.float32)
    if len(rows) != n or len(names) % 3 or sh_degree_of(len(names) // 3) is None:
        raise ValueError(f"{len(names)} coefficients of {len(rows):,} primitives fit no SH degree")
    levels = np.stack([rows[f"f_rest_{i}"] for i in range(len(names))], axis=1)
    shares = np.where(levels == 0, 0, np.where(levels == 255, 1, (levels + np.float32(0.5)) / 256))
    return ((shares - 0.5) * _HARMONICS_RANGE).reshape(n, 3, -1).transpose(0, 2, 1).astype(np.float32)
