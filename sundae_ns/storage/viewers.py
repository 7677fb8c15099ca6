"""Write a field for other viewers, in the format of the file's suffix: .ply, .spz, .sog or .glb."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.gaussians import mend
from sundae_ns.gaussians.parameters import sh_degree_of
from sundae_ns.storage.gltf import write_glb
from sundae_ns.storage.ply import MODEL_FRAME, write_ply
from sundae_ns.storage.primitives import ANTIALIASED
from sundae_ns.storage.sog import write_sog
from sundae_ns.storage.spz import MAX_SH_DEGREE, clamped, write_spz
from sundae_ns.storage.transform import similarity

FORMATS = (".ply", ".spz", ".sog", ".glb")

# In nerfstudio, z points up; in a 3DGS .ply, -y does.
_UPRIGHT = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])


class ViewerFile(NamedTuple):
    """Summary of a written file."""

    primitives: int
    dropped: int
    """Primitives left out because they are not finite."""
    degree: int
    """SH degree of the file."""
    clamped: int
    """Primitives with values beyond the range of a .spz, which stores the nearest value."""
    cut: bool
    """Whether the field has a higher SH degree than the file."""
    bytes: int


def check_format(path: Path) -> None:
    """Raise ``ConfigError`` unless the suffix of a file names a supported format."""
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path} has no supported suffix; name it {' or '.join((*FORMATS, '.html'))}")


def write_for_viewers(
    path: Path,
    params: Mapping[str, Tensor],
    *,
    antialiased: bool = False,
    upright: bool = False,
    in_model_frame: bool = True,
) -> ViewerFile:
    """Write the base colours of a field in the format of the file's suffix, atomically.

    Drops primitives without a meaning (``gaussians.mend``), and SH coefficients above the format's degree.

    Args:
        path: its folder must exist.
        params: the field; see :mod:`sundae_ns.gaussians.parameters`. A :class:`Field` says how it stores colours.
        antialiased: mark the scene as trained with antialiasing.
        upright: rotate the scene from nerfstudio's axes to those of a 3DGS .ply, so that viewers show it upright;
            a .glb is in any case.
        in_model_frame: the field is in the coordinates of nerfstudio's model, as a .ply then says.

    Raises:
        ConfigError: the suffix is not supported.
        DataError: the field has wrong shapes, or the format cannot store it.
        StorageError: the disk is full or not writable.
    """
    check_format(path)
    mended = mend(params)
    field = {name: value.detach().cpu() for name, value in mended.field.as_harmonics().items()}
    kind = path.suffix.lower()
    if upright and kind != ".glb":  # which is upright in any case
        field = similarity(field, _UPRIGHT, 1.0)
    coefficients = field["features_rest"].shape[1]
    if kind == ".ply":
        stated = {MODEL_FRAME: in_model_frame and not upright, ANTIALIASED: antialiased}
        write_ply(path, field, comments=[comment for comment, true in stated.items() if true])
    else:
        field["features_rest"] = field["features_rest"][:, : (MAX_SH_DEGREE + 1) ** 2 - 1]
        if kind == ".glb":
            write_glb(path, field, antialiased=antialiased, in_model_frame=in_model_frame)
        else:
            (write_spz if kind == ".spz" else write_sog)(path, field, antialiased=antialiased)
    kept = field["features_rest"].shape[1]
    return ViewerFile(
        primitives=len(field["means"]),
        dropped=mended.dropped,
        degree=sh_degree_of(kept) or 0,
        clamped=clamped(field) if kind == ".spz" else 0,
        cut=kept < coefficients,
        bytes=path.stat().st_size,
    )
