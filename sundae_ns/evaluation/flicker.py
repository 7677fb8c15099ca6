"""Steadiness along a camera path: how much neighbouring frames differ once the camera's motion is taken out.

A network in screen space sees every frame by itself, so nothing makes it agree with itself from one frame to the next.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

DEPTH_AGREEMENT = 0.02
"""Relative difference of depths up to which two frames are taken to see the same surface."""


class Frame(NamedTuple):
    """A rendered picture and where it was seen from."""

    rgb: Tensor
    """``[H, W, 3]``."""
    depth: Tensor
    """Depth along the camera's axis, scene units ``[H, W, 1]``."""
    accumulation: Tensor
    """``[H, W, 1]``."""
    viewmat: Tensor
    """World-to-camera, OpenCV axes ``[4, 4]``."""
    K: Tensor
    """Intrinsics, pixels ``[3, 3]``."""


class Change(NamedTuple):
    """Difference of two neighbouring frames."""

    mean: float
    """Mean absolute difference of colours over the pixels that both see; NaN if there is none."""
    share: float
    """Share of the pixels that both see."""


def change(before: Frame, after: Frame) -> Change:
    """How much a frame differs from the one before it, warped to its view by the depth of both.

    Pixels count where the surface is opaque, lies inside the earlier picture, and has the depth there that the motion
    demands: what is newly seen is no flicker.

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
    there = (rays * after.depth) @ motion[:3, :3].T + motion[:3, 3]
    depth = there[..., 2:]
    pixels = (there @ before.K.T)[..., :2] / depth.clamp_min(1e-8)
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
