"""The one reader of files of primitives: .ply, .spz, .sog, .glb, .splat, .ksplat, and checkpoints of gsplat."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sundae_ns.errors import DataError
from sundae_ns.gaussians.field import Field
from sundae_ns.gaussians.mending import Mended, mend
from sundae_ns.storage.gltf import read_glb
from sundae_ns.storage.kinds import kind_of_primitives
from sundae_ns.storage.ksplat import read_ksplat
from sundae_ns.storage.ply import is_nerfstudio_ply, ply_comments, read_ply
from sundae_ns.storage.sog import read_sog
from sundae_ns.storage.splat import read_gsplat, read_splat
from sundae_ns.storage.spz import read_spz

ANTIALIASED = "SplatRenderMode: mip"
"""Header comment of a .ply whose scene was trained with antialiasing."""
_log = logging.getLogger(__name__)


class StoredPrimitives(NamedTuple):
    """The primitives of a file."""

    mended: Mended
    """Those that have a meaning, with finite values, float32 on the CPU; and what was clamped or dropped."""
    antialiased: bool
    """Whether the file is marked as trained with antialiasing."""
    in_model_frame: bool
    """Whether coordinates are those of nerfstudio's model."""


def read_primitives(path: Path) -> StoredPrimitives:
    """Read a file of primitives of any program. Nothing in it is executed.

    Raises:
        DataError: the file is missing, damaged, of another kind, or has no finite primitive.
    """
    kind, antialiased, in_model_frame = kind_of_primitives(path), False, False
    if kind == "spz":
        params, antialiased = read_spz(path)
    elif kind == "sog":
        params, antialiased = read_sog(path)
    elif kind == "glb":
        params, antialiased, in_model_frame = read_glb(path)
    elif kind == "splat":
        params = read_splat(path)
    elif kind == "ksplat":
        params = read_ksplat(path)
    elif kind == "gsplat":
        params = read_gsplat(path)
    else:
        params, antialiased = read_ply(path), ANTIALIASED in ply_comments(path)
        in_model_frame = is_nerfstudio_ply(path)
    mended = mend(params)
    if not mended.field.num_primitives:
        raise DataError(f"{path} has {len(mended.mask):,} primitives, and none is finite; export it again")
    _state(mended, path)
    return StoredPrimitives(mended, antialiased, in_model_frame)


def mended_of(params: Mapping[str, Any], path: Path) -> Field:
    """The primitives of a field from a checkpoint that have a meaning, with finite values; logs what was changed."""
    mended = mend(params)
    _state(mended, path)
    return mended.field


def _state(mended: Mended, path: Path) -> None:
    if summary := mended.summary():
        _log.warning("%s: %s", path, summary)
