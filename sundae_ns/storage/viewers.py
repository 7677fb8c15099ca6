"""Fields as the files that other people's viewers open: which one a name asks for, and what each cannot hold."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.gaussians import finite_mask, rgb_to_sh
from sundae_ns.gaussians.parameters import sh_degree_of
from sundae_ns.storage.ply import write_ply
from sundae_ns.storage.point_cloud import MODEL_FRAME
from sundae_ns.storage.sog import write_sog
from sundae_ns.storage.spz import MAX_SH_DEGREE, write_spz
from sundae_ns.storage.transform import similarity

FORMATS = (".ply", ".spz", ".sog")
ANTIALIASED = "SplatRenderMode: mip"
"""Header comment of a .ply whose scene was trained with antialiasing."""

# nerfstudio's z is up, and so is -y of a 3DGS .ply.
_UPRIGHT = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])


class ViewerFile(NamedTuple):
    """What was written."""

    primitives: int
    dropped: int
    """Primitives that were not finite, and are left out."""
    degree: int
    """Of the harmonics in the file."""
    cut: bool
    """Whether the field has more of them, for which the format has no place."""
    bytes: int


def check_format(path: Path) -> None:
    """Raise ``ConfigError`` unless the name of a file says one of the formats."""
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path} is not named {' or '.join(FORMATS)}, which are what is written; rename it")


def write_for_viewers(
    path: Path,
    params: Mapping[str, Tensor],
    *,
    antialiased: bool = False,
    sigmoid_colors: bool = False,
    upright: bool = False,
) -> ViewerFile:
    """Write the base colours of a nerfstudio model's field in the format that the file's name says.

    Args:
        path: a .ply, .spz or .sog; its folder must exist. An older file is replaced once the new one is whole.
        params: the field; see :mod:`sundae_ns.gaussians.parameters`.
        antialiased: mark the scene as trained with antialiasing.
        sigmoid_colors: ``features_dc`` are logits of colours, as in a model of SH degree 0, and no harmonics.
        upright: turn the scene from nerfstudio's axes to those of a 3DGS .ply, so that viewers show it upright.

    Raises:
        ConfigError: the name says no format that is written.
        DataError: the field has wrong shapes, or what the format cannot hold.
        StorageError: the disk is full, or may not be written to.
    """
    check_format(path)
    finite = finite_mask(params)
    field = {name: value.detach()[finite].cpu() for name, value in params.items()}
    if sigmoid_colors:
        field["features_dc"] = rgb_to_sh(field["features_dc"].sigmoid())
    if upright:
        field = similarity(field, _UPRIGHT, 1.0)
    found = field["features_rest"].shape[1]
    kind = path.suffix.lower()
    if kind == ".ply":
        write_ply(path, field, comments=[*([] if upright else [MODEL_FRAME]), *([ANTIALIASED] if antialiased else [])])
    else:
        field["features_rest"] = field["features_rest"][:, : (MAX_SH_DEGREE + 1) ** 2 - 1]
        (write_spz if kind == ".spz" else write_sog)(path, field, antialiased=antialiased)
    kept = field["features_rest"].shape[1]
    return ViewerFile(
        len(field["means"]), int((~finite).sum()), sh_degree_of(kept) or 0, kept < found, path.stat().st_size
    )
