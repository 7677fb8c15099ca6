"""Clouds of captures: from COLMAP's models, and into the coordinates of the model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.data.utils import colmap_parsing_utils
from torch import Tensor

from sundae_ns.data.colmap import check_points
from sundae_ns.data.frame import COARSE_STEP, Array, float32_step
from sundae_ns.training.warning import warn


def colmap_points(model: Path) -> dict[int, Any]:
    """The points of a COLMAP model by their numbers, as nerfstudio reads them: binary before text."""
    if (model / "points3D.bin").exists():
        return dict(colmap_parsing_utils.read_points3D_binary(model / "points3D.bin"))
    return dict(colmap_parsing_utils.read_points3D_text(model / "points3D.txt"))


def colmap_cloud(model: Path) -> tuple[Tensor, Tensor]:
    """Positions ``[N, 3]`` float64 and colours ``[N, 3]`` uint8 of a COLMAP model; ``DataError`` if it is damaged."""
    check_points(model)
    points = colmap_points(model).values()
    positions = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    colours = np.array([point.rgb for point in points], dtype=np.uint8).reshape(-1, 3)
    return torch.from_numpy(positions), torch.from_numpy(colours)


def in_model_frame(points: Tensor, offset: Array | None, transform: Tensor, scale: float) -> Tensor:
    """Points ``[N, 3]`` of a capture after its offset, ``transform`` ``[3, 4]`` and ``scale``, float32."""
    if offset is not None:
        points = points.double() - torch.from_numpy(offset)
    return (points.float() @ transform[:3, :3].T + transform[:3, 3]) * scale


def warn_of_coarse_cloud(points: Tensor, offset: Array | None, name: str) -> None:
    """Warn of a cloud far from the origin that was written in float32: its points are already rounded."""
    finite = points[torch.isfinite(points).all(dim=1)].numpy()
    if offset is None or not len(finite) or not np.array_equal(finite, finite.astype(np.float32)):
        return
    if float32_step(finite) > COARSE_STEP:
        step = np.spacing(np.float32(np.abs(offset).max()))
        warn(
            f"{name} has float32 coordinates that are {step:.2g} apart, as it lies far from the origin; export it with "
            "double coordinates, or shifted"
        )
