"""Rotation matrices of quaternions."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices ``[N, 3, 3]`` of wxyz quaternions ``[N, 4]`` of any length; all-zero ones give the identity."""
    w, x, y, z = normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([entry for row in rows for entry in row], dim=-1).reshape(-1, 3, 3)
