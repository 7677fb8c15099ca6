"""Scenes of other trainers and viewers: the .splat of the first web viewers, and the checkpoints of gsplat."""

from __future__ import annotations

import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sundae_ns.errors import DataError, reading, regular
from sundae_ns.gaussians.parameters import SPLAT_NAMES, odd_shapes, rgb_to_sh
from sundae_ns.storage.archive import damage_of, load_tensors
from sundae_ns.storage.compressed_ply import LEAST_OPACITY

_SPLAT = np.dtype([("means", "<f4", 3), ("widths", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_GSPLAT_NAMES = ("means", "scales", "quats", "opacities", "sh0", "shN")
_RANK = re.compile(r"(.*_rank)\d+")


def read_splat(path: Path) -> dict[str, Tensor]:
    """Read a .splat: 32 bytes a primitive, without a header and without view-dependent colours.

    Returns:
        A field by the names of :data:`sundae_ns.gaussians.parameters.SPLAT_NAMES`, float32 on the CPU, in the file's
        coordinates. Log-scales of widths of 0 are infinite; see ``gaussians.mend``.

    Raises:
        DataError: the file is missing or empty, or has no whole number of primitives.
    """
    with reading(path, "a complete .splat"):
        size = regular(path).stat().st_size
        if size == 0 or size % _SPLAT.itemsize:
            raise ValueError(f"{size:,} bytes are no whole number of primitives of {_SPLAT.itemsize} bytes")
        rows = np.fromfile(path, _SPLAT)
    colors = torch.from_numpy(rows["rgba"] / np.float32(255))
    return {
        "means": torch.from_numpy(rows["means"].copy()),
        "scales": torch.from_numpy(rows["widths"].copy()).log(),
        "quats": torch.from_numpy((rows["quats"].astype(np.float32) - 128) / 128),
        "features_dc": rgb_to_sh(colors[:, :3]),
        "features_rest": torch.zeros(len(rows), 0, 3),
        "opacities": torch.logit(colors[:, 3:], eps=LEAST_OPACITY),
    }


def read_gsplat(path: Path) -> dict[str, Tensor]:
    """Read a checkpoint of gsplat's trainer, with those of the other ranks beside it. No code in it runs.

    Args:
        path: ``ckpt_29999_rank0.pt``; the primitives of a training on several GPUs are spread over ``_rank0``,
            ``_rank1`` and so on.

    Returns:
        A field as that of :func:`read_splat`, in the coordinates of gsplat's training.

    Raises:
        DataError: a file is missing or damaged, or holds no primitives with SH colours.
    """
    found = _RANK.fullmatch(path.stem)
    ranks = [path] if found is None else [p for p in path.parent.glob("*.pt") if _of_same_step(p, found[1])]
    parts = [_part(each) for each in sorted(ranks or [path])]
    if any(part["features_rest"].shape[1:] != parts[0]["features_rest"].shape[1:] for part in parts):
        raise DataError(f"{path} and the ranks beside it have different SH degrees; give files of one training")
    return {name: torch.cat([part[name] for part in parts]) for name in SPLAT_NAMES}


def _of_same_step(path: Path, prefix: str) -> bool:
    found = _RANK.fullmatch(path.stem)
    return found is not None and found[1] == prefix


def _part(path: Path) -> dict[str, Tensor]:
    """The primitives of one file."""
    with reading(path, "a checkpoint of gsplat", mend="give another file"), regular(path).open("rb") as file:
        broken = damage_of(file)
        if broken is not None:
            raise ValueError(broken)
        try:
            loaded = load_tensors(file)
        except pickle.UnpicklingError as error:
            raise ValueError("it holds more than tensors and plain values, or nothing that can be read") from error
        splats = loaded.get("splats") if isinstance(loaded, dict) else None
        if not isinstance(splats, Mapping):
            raise ValueError("it holds no splats")
        missing = [name for name in _GSPLAT_NAMES if not isinstance(splats.get(name), Tensor)]
        if missing and isinstance(splats.get("colors"), Tensor):
            raise ValueError("its colours need a network (app_opt); train with SH colours")
        if missing:
            raise ValueError(f"its splats lack {', '.join(missing)}")
        values: dict[str, Any] = {name: splats[name].detach().float() for name in _GSPLAT_NAMES}
        field = {
            "means": values["means"],
            "scales": values["scales"],
            "quats": values["quats"],
            "features_dc": values["sh0"].flatten(1),
            "features_rest": values["shN"],
            "opacities": values["opacities"].reshape(-1, 1),
        }
        for odd in odd_shapes(field):
            raise ValueError(odd)
    return field
