"""EWA projection of 3D Gaussians to the screen, in plain autograd torch.

Zwicker et al., "EWA Splatting", 2002, with the conventions of 3DGS. The perspective map is linearised at the centre.
Its slope is clamped to the image plus 0.15 of its size on each side. Every footprint is blurred by 0.3 square pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sundae_ns.gaussians.covariance import rotation_matrices
from sundae_ns.rasterization.types import Inputs

BLUR = 0.3
"""Variance in square pixels added to each footprint."""

FOV_MARGIN = 0.3
MAX_RADIUS = 1e9  # keeps radii within int32


@dataclass(frozen=True)
class Projection:
    """N primitives on the screen, in pixels; entries of culled primitives (radius 0) are finite and meaningless."""

    means2d: Tensor  # [N, 2]
    covars2d: Tensor  # [N, 3]: xx, xy, yy after the blur
    conics: Tensor  # [N, 3]: the inverse of the covariance, xx, xy, yy
    depths: Tensor  # [N]: camera z
    compensations: Tensor  # [N]: square root of the ratio of determinants before and after the blur
    radii: Tensor  # [N], int32


def camera_center(viewmat: Tensor) -> Tensor:
    """Position of a camera ``[3]``, from its world-to-camera transform ``[4, 4]``."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def project(inputs: Inputs) -> Projection:
    """Project primitives into a pinhole view."""
    rotation, translation = inputs.viewmat[:3, :3], inputs.viewmat[:3, 3]
    camera = inputs.means @ rotation.T + translation
    z = camera[:, 2]
    in_range = (z >= inputs.near_plane) & (z <= inputs.far_plane) & (z > 0)
    # Replace culled centres first: where() alone would still pass NaN from 1 / z to the gradients.
    camera = torch.where(in_range[:, None], camera, camera.new_tensor([0.0, 0.0, 1.0]))
    x, y, z = camera.unbind(-1)

    K, width, height = inputs.K, inputs.width, inputs.height
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)

    # A 3x3 root of the covariance maps the unit sphere to the primitive; the root's two screen rows map it to the
    # footprint.
    root = (rotation @ rotation_matrices(inputs.quats)) * inputs.scales[:, None, :]
    slope_x = _limit_slope(x / z, fx, cx, width)
    slope_y = _limit_slope(y / z, fy, cy, height)
    row_x = (fx / z)[:, None] * (root[:, 0] - slope_x[:, None] * root[:, 2])
    row_y = (fy / z)[:, None] * (root[:, 1] - slope_y[:, None] * root[:, 2])
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)

    # Lagrange's identity: a sum of squares, where xx * yy - xy * xy would cancel for thin primitives.
    sharp_det = torch.linalg.cross(row_x, row_y).square().sum(-1)
    det = sharp_det + BLUR * (xx + yy) + BLUR * BLUR
    xx, yy = xx + BLUR, yy + BLUR
    conics = torch.stack([yy, -xy, xx], dim=-1) / det[:, None]

    ratio = sharp_det / det
    positive = ratio > 0
    compensations = torch.where(positive, torch.where(positive, ratio, 1.0).sqrt(), 0.0)

    covars2d = torch.stack([xx, xy, yy], dim=-1)
    radii = _screen_radii(means2d.detach(), covars2d.detach(), width, height) * in_range
    return Projection(means2d, covars2d, conics, camera[:, 2], compensations, radii.to(torch.int32))


def _limit_slope(slope: Tensor, focal: Tensor, centre: Tensor, size: int) -> Tensor:
    margin = FOV_MARGIN * 0.5 * size / focal
    return torch.clamp(slope, min=-centre / focal - margin, max=(size - centre) / focal + margin)


def _screen_radii(means2d: Tensor, covars2d: Tensor, width: int, height: int) -> Tensor:
    """Three standard deviations of the longer axis, rounded up; 0 where that square does not touch the image."""
    xx, xy, yy = covars2d.unbind(-1)
    spread = (0.25 * (xx - yy).square() + xy * xy).clamp(min=0.01).sqrt()
    radii = torch.ceil(3.0 * (0.5 * (xx + yy) + spread).sqrt()).clamp(max=MAX_RADIUS)
    size = means2d.new_tensor([width, height])
    inside = (means2d + radii[:, None] > 0) & (means2d - radii[:, None] < size)
    return radii * inside.all(dim=-1)
