"""Flicker along a camera path: the difference of neighbouring frames after the camera's motion is compensated.

A screen-space network processes every frame independently, so nothing enforces consistency between frames.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

DEPTH_AGREEMENT = 0.02
"""Largest relative depth difference at which two frames count as seeing the same surface."""


class Frame(NamedTuple):
    """A rendered image with its camera."""

    rgb: Tensor
    """Rendered colours ``[H, W, 3]``."""
    depth: Tensor
    """Depth along the optical axis, scene units ``[H, W, 1]``."""
    accumulation: Tensor
    """Accumulated opacity ``[H, W, 1]``."""
    viewmat: Tensor
    """World-to-camera, OpenCV axes ``[4, 4]``."""
    K: Tensor
    """Intrinsics, pixels ``[3, 3]``."""


class Change(NamedTuple):
    """Difference of two neighbouring frames."""

    mean: float
    """Mean absolute colour difference over the pixels that both frames see; NaN if there are none."""
    share: float
    """Share of the later frame's pixels that both frames see."""


def change(before: Frame, after: Frame) -> Change:
    """Difference of a frame and the one before it, warped into its view by depth.

    A pixel counts if its surface is opaque, lies inside the earlier frame, and has the expected depth there. Surfaces that
    become visible are not flicker.

    Args:
        before: the earlier frame.
        after: the later frame, of the same size.
    """
    height, width, _ = after.rgb.shape
    rows = torch.arange(height, dtype=after.K.dtype, device=after.K.device) + 0.5
    columns = torch.arange(width, dtype=after.K.dtype, device=after.K.device) + 0.5
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ torch.linalg.inv(after.K).T
    motion = before.viewmat @ torch.linalg.inv(after.viewmat)
    points = (rays * after.depth) @ motion[:3, :3].T + motion[:3, 3]
    depth = points[..., 2:]
    pixels = (points @ before.K.T)[..., :2] / depth.clamp_min(1e-8)
    grid = 2 * pixels / pixels.new_tensor([width, height]) - 1
    sampled = F.grid_sample(
        torch.cat([before.rgb, before.depth, before.accumulation], dim=-1).permute(2, 0, 1)[None],
        grid[None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )[0].permute(1, 2, 0)
    seen = (
        (depth > 0)
        & (grid.abs() <= 1).all(dim=-1, keepdim=True)
        & ((sampled[..., 3:4] - depth).abs() <= DEPTH_AGREEMENT * depth)
        & (torch.minimum(sampled[..., 4:], after.accumulation) > 0.95)
    )[..., 0]
    difference = (sampled[..., :3] - after.rgb).abs().mean(dim=-1)
    return Change(float(difference[seen].mean()), float(seen.float().mean()))
