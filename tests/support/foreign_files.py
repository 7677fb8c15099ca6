"""Files of other programs, made in small: .splat, .ksplat, compressed .ply, colours, checkpoints of gsplat."""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
import zstandard
from plyfile import PlyData, PlyElement
from torch import Tensor

from sundae_ns.core.gaussians import SH_C0
from sundae_ns.io.ply import write_ply

_CHUNK = 256
_STORED = Path(__file__).parents[1] / "io" / "foreign"


def small_field(n: int = 300, degree: int = 1) -> dict[str, Tensor]:
    """A field of visible Gaussians within a unit cube."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    return {
        "means": uniform(n, 3, low=-1, high=1),
        "scales": uniform(n, 3, low=-4, high=-2),
        "quats": torch.nn.functional.normalize(torch.randn(n, 4, generator=generator)),
        "features_dc": uniform(n, 3, low=-1.5, high=1.5),
        "features_rest": uniform(n, (degree + 1) ** 2 - 1, 3, low=-1, high=1),
        "opacities": uniform(n, 1, low=-2, high=4),
    }


def columns_of(path: Path) -> dict[str, np.ndarray]:
    """The properties of the vertices of a .ply, in their order."""
    rows = PlyData.read(str(path), mmap=False)["vertex"].data
    return {name: np.asarray(rows[name]) for name in rows.dtype.names}


def write_columns(path: Path, columns: Mapping[str, np.ndarray], **options: Any) -> None:
    """Write a .ply of vertices with these properties; options of ``PlyData``."""
    rows = np.empty(len(next(iter(columns.values()))), [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")], **options).write(str(path))


def _bytes(shares: Tensor) -> np.ndarray:
    return (shares * 255).round().clamp(0, 255).numpy().astype(np.uint8)


def colors_of(gaussians: Mapping[str, Tensor]) -> Tensor:
    """View-independent colours ``[N, 3]``."""
    return 0.5 + SH_C0 * gaussians["features_dc"]


def write_splat(path: Path, gaussians: Mapping[str, Tensor]) -> None:
    rows = np.zeros(len(gaussians["means"]), [("m", "<f4", 3), ("s", "<f4", 3), ("c", "u1", 4), ("q", "u1", 4)])
    rows["m"], rows["s"] = gaussians["means"].numpy(), gaussians["scales"].exp().numpy()
    rows["c"] = _bytes(torch.cat([colors_of(gaussians), gaussians["opacities"].sigmoid()], dim=1))
    rows["q"] = (gaussians["quats"] * 128 + 128).round().clamp(0, 255).numpy().astype(np.uint8)
    path.write_bytes(rows.tobytes())


def _word(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    word = np.zeros(len(shares), np.uint32)
    for column, width in zip(shares.T, bits, strict=True):
        level = np.rint(np.clip(column, 0, 1) * ((1 << width) - 1)).astype(np.uint32)
        word = (word << np.uint32(width)) | level
    return word


def write_compressed_ply(path: Path, gaussians: Mapping[str, Tensor], *, old: bool = False, comment: str = "") -> None:
    """As SuperSplat writes it; ``old`` ones have no bounds of colours."""
    n, chunks = len(gaussians["means"]), []
    vertex = np.zeros(n, [(f"packed_{name}", "<u4") for name in ("position", "rotation", "scale", "color")])
    colors = colors_of(gaussians).numpy()
    for first in range(0, n, _CHUNK):
        rows, bounds = slice(first, first + _CHUNK), {}
        blocks = {"": gaussians["means"].numpy(), "scale_": gaussians["scales"].numpy(), "color": colors}
        for kind, values in blocks.items():
            axes = "rgb" if kind == "color" else "xyz"
            low, high = values[rows].min(axis=0), values[rows].max(axis=0)
            if kind == "color" and old:
                low, high = np.zeros(3), np.ones(3)
            names = [f"{kind.removeprefix('color')}{axis}" for axis in axes]
            if not (kind == "color" and old):
                bounds |= {f"min_{name}": value for name, value in zip(names, low, strict=True)}
                bounds |= {f"max_{name}": value for name, value in zip(names, high, strict=True)}
            shares = (values[rows] - low) / np.where(high > low, high - low, 1)
            if kind == "color":
                alphas = gaussians["opacities"][rows].sigmoid().numpy()
                vertex["packed_color"][rows] = _word(np.concatenate([shares, alphas], axis=1), (8, 8, 8, 8))
            else:
                vertex["packed_position" if kind == "" else "packed_scale"][rows] = _word(shares, (11, 10, 11))
        chunks.append(bounds)
    quats = gaussians["quats"].numpy()
    largest = np.abs(quats).argmax(axis=1)
    positive = quats * np.sign(quats[np.arange(n), largest])[:, None]
    others = positive[np.arange(4) != largest[:, None]].reshape(n, 3) * math.sqrt(0.5) + 0.5
    vertex["packed_rotation"] = _word(np.concatenate([largest[:, None] / 3, others], axis=1), (2, 10, 10, 10))
    table = np.array([tuple(chunk.values()) for chunk in chunks], [(name, "<f4") for name in chunks[0]])
    elements = [PlyElement.describe(table, "chunk"), PlyElement.describe(vertex, "vertex")]
    rest = gaussians["features_rest"].numpy()
    if rest.shape[1]:
        levels = np.floor((rest / 8 + 0.5) * 256).clip(0, 255).astype(np.uint8).transpose(0, 2, 1).reshape(n, -1)
        sh = np.zeros(n, [(f"f_rest_{i}", "u1") for i in range(levels.shape[1])])
        for i, name in enumerate(sh.dtype.names or ()):
            sh[name] = levels[:, i]
        elements.append(PlyElement.describe(sh, "sh"))
    PlyData(elements, byte_order="<", comments=[comment] if comment else []).write(str(path))


def write_colored_ply(path: Path, gaussians: Mapping[str, Tensor], dtype: str = "u1", most: float = 255) -> None:
    """As ``ns-export gaussian-splat --ply-color-mode rgb``: colours in place of SH coefficients."""
    values = {"x": gaussians["means"][:, 0], "y": gaussians["means"][:, 1], "z": gaussians["means"][:, 2]}
    values |= {"opacity": gaussians["opacities"][:, 0], **{f"scale_{i}": gaussians["scales"][:, i] for i in range(3)}}
    values |= {f"rot_{i}": gaussians["quats"][:, i] for i in range(4)}
    columns = {name: value.numpy() for name, value in values.items()}
    for name, color in zip(("red", "green", "blue"), most * colors_of(gaussians).numpy().T, strict=True):
        exact = dtype.endswith(("f4", "f8"))
        columns[name] = (color if exact else np.rint(color.clip(0, most))).astype(dtype)
    write_columns(path, columns, byte_order="<", comments=["Generated by Nerstudio 1.1.5"])


def write_gsplat(path: Path, gaussians: Mapping[str, Tensor], **others: object) -> None:
    """As ``simple_trainer.py`` of gsplat."""
    splats = {name: gaussians[name] for name in ("means", "scales", "quats")}
    splats |= {
        "opacities": gaussians["opacities"][:, 0],
        "sh0": gaussians["features_dc"][:, None],
        "shN": gaussians["features_rest"],
    }
    torch.save({"step": 6999, "splats": splats, **others}, path)


def write_checkpoint(
    path: Path, gaussians: Mapping[str, Tensor], extra: Mapping[str, Any] = MappingProxyType({}), **others: object
) -> None:
    """As nerfstudio's trainer after its first step; ``extra`` is further state of the pipeline."""
    state = {f"_model.gauss_params.{name}": value for name, value in gaussians.items()}
    torch.save({"step": 1, "pipeline": state | dict(extra), **others}, path)


def spz(
    gaussians: Mapping[str, Tensor],
    version: int,
    *,
    axes: int | None = None,
    antialiased: bool = False,
    bits: int = 12,
    count: int | None = None,
    degree: int | None = None,
) -> bytes:
    """A .spz by its specification; ``axes`` state a coordinate system, the last three change its header alone."""
    values = {name: value.numpy() for name, value in gaussians.items()}
    n, coefficients = values["features_rest"].shape[:2]
    fixed = np.rint(values["means"] * 4096).astype("<i4").view(np.uint8).reshape(n, 3, 4)[..., :3]
    quats = np.roll(values["quats"], -1, axis=1)  # xyzw
    largest = np.abs(quats).argmax(axis=1) if version > 2 else np.full(n, 3)
    quats = quats * np.where(quats[np.arange(n), largest] < 0, -1, 1)[:, None]
    words = largest.astype("<u4")
    for others in quats[np.arange(4) != largest[:, None]].reshape(n, 3).T if version > 2 else ():
        words = words << 10 | (others < 0) << 9 | np.rint(np.abs(others) * math.sqrt(2) * 511).astype("<u4")

    def levels(values: np.ndarray) -> np.ndarray:
        return np.rint(values).clip(0, 255).astype(np.uint8)

    parts = [
        values["means"].astype("<f2") if version == 1 else fixed,
        levels(255 / (1 + np.exp(-values["opacities"]))),
        levels(values["features_dc"] * 0.15 * 255 + 127.5),
        levels(values["scales"] * 16 + 160),
        words.astype("<u4") if version > 2 else levels(quats[:, :3] * 127.5 + 127.5),
        levels(values["features_rest"] * 128 + 128),
    ]
    stored = [part.tobytes() for part in parts if part.size]
    about = (n if count is None else count, math.isqrt(coefficients) if degree is None else degree, bits)
    flags = antialiased + (0 if axes is None else 2)
    header = struct.pack("<4sIIBBBB", b"NGSP", version, *about, flags, 0 if version < 4 else len(stored))
    extension = b"" if axes is None else struct.pack("<IIIIII", 0xADBE0002, 4, 0, 0xADBE0003, 4, axes)
    if version < 4:
        return gzip.compress(header + b"".join(stored) + extension)
    frames = [zstandard.ZstdCompressor().compress(part) for part in stored]
    table = [struct.pack("<QQ", len(frame), len(part)) for frame, part in zip(frames, stored, strict=True)]
    return header + struct.pack("<I12x", 32 + len(extension)) + extension + b"".join([*table, *frames])


def ksplat(level: int, degree: int) -> Path:
    """A file that GaussianSplats3D 0.4.7 wrote of ``KSPLAT``, by foreign/ksplat.mjs."""
    return _STORED / f"level_{level}_degree_{degree}.ksplat"


KSPLAT = small_field(30, 3)


def copy_ksplat(path: Path, _: Mapping[str, Tensor] = KSPLAT) -> None:
    path.write_bytes(ksplat(1, 2).read_bytes())


FOREIGN: dict[str, Callable[[Path, Mapping[str, Tensor]], None]] = {
    "a.splat": write_splat,
    "a.compressed.ply": write_compressed_ply,
    "colors.ply": write_colored_ply,
    "ckpt_6999_rank0.pt": write_gsplat,
    "a.ksplat": copy_ksplat,
    "plain.ply": write_ply,
}
"""Files by their names, and their writers."""
