"""The .sog of PlayCanvas, version 2: a zip of lossless WebP pictures with one pixel a primitive, and ``meta.json``.

Written from the format's public description, for no package of Python that is kept up writes it. What is rounded: positions
to 65,536 levels an axis after ``sign(x) log(1 + |x|)``; log-scales, colours of band 0 and coefficients of further bands to
256 values each, found by k-means in one dimension; opacities to 256 levels after activation; rotations to the smallest three of
8 bits. Bands 1 to 3 of a primitive are a row of a palette of at most 65,536 rows: each its own while there are no more
primitives, else centres of a k-means in two levels.

Coordinates are those of a .ply, unturned, as in the files of ``splat-transform``.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sundae_ns.storage.atomic import replacing
from sundae_ns.storage.packing.codebooks import kmeans, nearest_centre
from sundae_ns.storage.packing.morton import scene_order
from sundae_ns.storage.spz import checked

MAX_PALETTE = 1 << 16
"""Rows of harmonics that two bytes can name."""
_ROW_ENTRIES = 64  # rows of the palette in a row of its picture
_ENTRIES = 256  # numbers that a byte can name
_COARSE = 256  # cells that share out the rows of a large palette
_ROUNDS = 30  # of Lloyd's, for numbers on a line
_LEVELS = 65535  # highest level of a position, of two bytes
_FIRST_MODE = 252  # alpha of a rotation whose first component is left out; the others follow


def write_sog(
    path: Path, params: Mapping[str, Tensor], *, antialiased: bool = False, max_palette: int = MAX_PALETTE
) -> None:
    """Write the base colours of a field as a bundled .sog; an existing file is replaced only once the new one is whole.

    Args:
        path: the file; its folder must exist.
        params: a field of finite values and SH degree 3 at most; see :mod:`sundae_ns.gaussians.parameters`. ``features``
            are left out, and the order of primitives changes.
        antialiased: mark the scene as trained with antialiasing.
        max_palette: most rows of the palette of harmonics, 512 to 65,536.

    Raises:
        DataError: the field has no primitives, a degree that the format cannot hold, or wrong shapes.
        StorageError: the disk is full, or may not be written to.
    """
    field = checked(path, params)
    order = scene_order(field["means"].numpy())
    arrays = {name: value.numpy()[order] for name, value in field.items()}
    n = len(order)

    bent = np.sign(arrays["means"]) * np.log1p(np.abs(arrays["means"].astype(np.float64)))
    low, high = bent.min(axis=0), bent.max(axis=0)
    levels = np.rint((bent - low) / np.where(high > low, high - low, 1.0) * _LEVELS).astype(np.uint16)
    scale_values, scale_codes = codebook(arrays["scales"])
    color_values, color_codes = codebook(arrays["features_dc"])
    alphas = np.rint(255 / (1 + np.exp(-arrays["opacities"].astype(np.float64)))).astype(np.uint8)

    pictures = {
        "means_l": _square((levels & 255).astype(np.uint8)),
        "means_u": _square((levels >> 8).astype(np.uint8)),
        "scales": _square(scale_codes),
        "quats": _square(_smallest_three(arrays["quats"])),
        "sh0": _square(np.concatenate([color_codes, alphas], axis=1)),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "sundae-ns"},
        "count": n,
        "antialias": antialiased,
        # splat-transform of 2026 reads this entry instead of the one before.
        **({"model": "antialiased"} if antialiased else {}),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_values.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_values.tolist(), "files": ["sh0.webp"]},
    }
    coefficients = arrays["features_rest"].shape[1]
    if coefficients:
        rows, labels = palette(arrays["features_rest"].reshape(n, -1), max_palette)
        values, codes = codebook(rows.reshape(len(rows), coefficients, 3))
        padded = np.zeros((math.ceil(len(rows) / _ROW_ENTRIES) * _ROW_ENTRIES, coefficients, 3), np.uint8)
        padded[: len(rows)] = codes
        pictures["shN_centroids"] = padded.reshape(-1, _ROW_ENTRIES * coefficients, 3)
        named = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
        pictures["shN_labels"] = _square(named.astype(np.uint8))
        meta["shN"] = {
            "count": len(rows),
            "bands": math.isqrt(coefficients + 1) - 1,
            "codebook": values.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    with replacing(Path(path)) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as bundle:
        # A fixed date: the same field gives the same bytes.
        bundle.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))
        for name, pixels in pictures.items():
            bundle.writestr(zipfile.ZipInfo(f"{name}.webp"), _webp(pixels))


def codebook(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """The 256 numbers that stand for many with a small squared error, by Lloyd's rounds on the line (1957).

    Args:
        values: of any shape, at least one, finite.

    Returns:
        The numbers, rising, ``[256]``, and which of them is nearest to each value, in the shape of ``values``.
    """
    rising = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(rising)])
    # Half where the values are many, half over the whole range, for the few at its ends.
    usual = np.quantile(rising, (np.arange(_ENTRIES // 2) + 0.5) / (_ENTRIES // 2))
    centres = np.sort(np.concatenate([usual, np.linspace(rising[0], rising[-1], _ENTRIES // 2)]))
    for _ in range(_ROUNDS):
        bounds = np.concatenate([[0], np.searchsorted(rising, _middles(centres)), [len(rising)]])
        number = np.diff(bounds)
        # Sorted: means of rounded sums may pass each other.
        centres = np.sort(np.where(number > 0, np.diff(sums[bounds]) / np.maximum(number, 1), centres))
    numbers = centres.astype(np.float32)
    return numbers, np.searchsorted(_middles(numbers.astype(np.float64)), values).astype(np.uint8)


def _middles(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    return (centres[1:] + centres[:-1]) / 2


def palette(
    rows: NDArray[np.float32], most: int = MAX_PALETTE, *, seed: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """At most ``most`` rows that stand for all, and which one stands for each.

    A k-means of 65,536 centres over a million rows would take hours, so it has two levels: 256 coarse centres share the
    rows out, and each cell gets centres of its own in proportion to its rows.

    Args:
        rows: ``[N, D]``.
        most: at least 512; with as few rows as that, each stands for itself.
        seed: of the first centres.

    Returns:
        Rows ``[P, D]`` and indices ``[N]``.
    """
    n = len(rows)
    if n <= most:
        return rows, np.arange(n)
    generator = torch.Generator().manual_seed(seed)
    vectors = torch.from_numpy(np.ascontiguousarray(rows)).double()
    cell_of = nearest_centre(vectors, kmeans(vectors, _COARSE, generator))
    centres: list[Tensor] = []
    labels = torch.empty(n, dtype=torch.int64)
    found = 0
    for cell in range(_COARSE):
        (members,) = torch.nonzero(cell_of == cell, as_tuple=True)
        if not len(members):
            continue
        count = min(1 + (most - _COARSE) * len(members) // n, len(members))
        fine = kmeans(vectors[members], count, generator)
        labels[members] = found + nearest_centre(vectors[members], fine)
        centres.append(fine)
        found += count
    return torch.cat(centres).float().numpy(), labels.numpy()


def _smallest_three(quats: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Unit quaternions wxyz ``[N, 4]`` as pixels ``[N, 4]``: the three smaller components, and which is left out."""
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    positive = quats * np.where(quats[rows, largest] < 0, -1, 1)[:, None]
    others = positive[np.arange(4) != largest[:, None]].reshape(-1, 3)
    codes = np.rint((others * math.sqrt(0.5) + 0.5) * 255).clip(0, 255)
    return np.concatenate([codes, _FIRST_MODE + largest[:, None]], axis=1).astype(np.uint8)


def _square(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pixels ``[N, C]`` as a nearly square picture ``[H, W, C]``, the last row filled with zeros."""
    n, channels = pixels.shape
    width = math.isqrt(n - 1) + 1
    picture = np.zeros((math.ceil(n / width) * width, channels), np.uint8)
    picture[:n] = pixels
    return picture.reshape(-1, width, channels)


def _webp(pixels: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    # exact: colours stay where alpha, an opacity here, is 0.
    Image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()
