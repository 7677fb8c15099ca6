"""Points of a .ply with their colours, under the names and in the ranges that programs write."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from plyfile import PlyElement
from torch import Tensor

from sundae_ns.gaussians.parameters import sh_to_rgb

_GREY = 128
_COLOURS = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    ("scalar_red", "scalar_green", "scalar_blue"),
    ("f_dc_0", "f_dc_1", "f_dc_2"),
)
"""Names of colours, in lower case."""
_BRIGHTEST = 2.0
"""Largest channel of a cloud whose floats have 1 for white; some programs overshoot."""


def points_of(vertex: PlyElement, precise: bool) -> tuple[Tensor, Tensor] | None:
    """Positions ``[N, 3]`` and colours ``[N, 3]`` uint8 of vertices, mid-grey if they have none.

    Args:
        vertex: of any .ply; None is returned if it has no positions.
        precise: positions as float64, not float32.
    """
    names = {prop.name.lower(): prop.name for prop in vertex.properties}
    if not names.keys() >= {"x", "y", "z"}:
        return None
    points = _columns(vertex, [names[axis] for axis in "xyz"], np.float64 if precise else np.float32)
    channels = next((found for found in _COLOURS if names.keys() >= set(found)), None)
    if channels is None:
        return points, torch.full((len(points), 3), _GREY, dtype=torch.uint8)
    colours = _columns(vertex, [names[name] for name in channels], np.float32)
    if channels[0].startswith("f_dc"):
        colours = 255 * sh_to_rgb(colours)
    else:
        colours *= 255 / _full_scale(vertex[names[channels[0]]].dtype, colours)
    return points, colours.nan_to_num_(nan=0.0).round_().clamp_(0, 255).to(torch.uint8)


def _columns(vertex: PlyElement, names: Sequence[str], kind: type[np.floating[Any]]) -> Tensor:
    table = np.empty((vertex.count, len(names)), kind)
    for i, name in enumerate(names):
        with np.errstate(over="ignore"):  # values beyond float32 become infinite; callers drop them
            table[:, i] = vertex[name]
    return torch.from_numpy(table)


def _full_scale(kind: np.dtype[np.generic], colours: Tensor) -> float:
    """The value of a full colour channel: 1, 255 or 65,535, by the type of the numbers and the largest of them."""
    finite = colours[colours.isfinite()]
    largest = float(finite.max()) if len(finite) else 0.0
    if kind.kind == "f" and largest <= _BRIGHTEST:
        return 1.0
    return 65535.0 if largest > 255 else 255.0
