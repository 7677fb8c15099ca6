"""Flicker along a camera path, as StopThePop measures popping (Radl et al., SIGGRAPH 2024).

An earlier frame is warped onto a later one. Where both see the same surface, what is left of their difference is view
dependence, error of the warp, and flicker. The first two are about the same in all methods, so the least squared error of a
pixel over the methods is subtracted. StopThePop warps by optical flow; here depth and cameras are known, so they say where a
surface moves. A sharper image leaves more of it than a blurred one, with the same flicker.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

SAME_DEPTH = 0.02
"""Relative difference of depths up to which two frames see the same surface."""
LEAST_ALPHA = 0.95
"""Accumulation from which on a pixel shows a surface."""


class Frame(NamedTuple):
    """One frame of a path, drawn by several methods."""

    images: Tensor
    """One image of each method ``[M, H, W, 3]``."""
    depth: Tensor
    """Depth along the optical axis, world units ``[H, W, 1]``."""
    alpha: Tensor
    """Accumulation ``[H, W, 1]``."""
    viewmat: Tensor
    """World-to-camera, OpenCV axes ``[4, 4]``."""
    K: Tensor
    """Intrinsics in pixels ``[3, 3]``."""


def warp(earlier: Frame, later: Frame) -> tuple[Tensor, Tensor]:
    """The images of an earlier frame in the pixels of a later one.

    Returns:
        The images ``[M, H, W, 3]``, and where both frames see the same surface ``[H, W]``, bool.
    """
    height, width = later.depth.shape[:2]
    device = later.depth.device
    rows, columns = (torch.arange(side, device=device) + 0.5 for side in (height, width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    points = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ torch.linalg.inv(later.K).T * later.depth
    motion = earlier.viewmat @ torch.linalg.inv(later.viewmat)
    points = points @ motion[:3, :3].T + motion[:3, 3]
    z = points[..., 2:]
    sides = torch.tensor([earlier.depth.shape[1], earlier.depth.shape[0]], device=device)
    grid = 2 * (points @ earlier.K.T)[..., :2] / z.clamp_min(1e-8) / sides - 1

    def sampled(value: Tensor, mode: str) -> Tensor:
        """Values ``[B, H, W, C]`` of the earlier frame where the later frame's pixels lie in it."""
        grids = grid.expand(len(value), -1, -1, -1)
        found = F.grid_sample(value.permute(0, 3, 1, 2), grids, mode=mode, padding_mode="border", align_corners=False)
        return found.permute(0, 2, 3, 1)

    depth, alpha = sampled(torch.cat([earlier.depth, earlier.alpha], dim=-1)[None], "bilinear")[0].split(1, dim=-1)
    inside = (z > 0) & (grid.abs() <= 1).all(dim=-1, keepdim=True)
    same = ((depth - z).abs() <= SAME_DEPTH * z) & (torch.minimum(alpha, later.alpha) > LEAST_ALPHA)
    return sampled(earlier.images, "bicubic"), (inside & same)[..., 0]


class Flicker:
    """Sums over the pairs of frames of one or more paths."""

    def __init__(self) -> None:
        self._errors: Tensor | None = None
        self._least = 0.0
        self._seen, self._pixels = 0, 0

    def add(self, earlier: Frame, later: Frame) -> None:
        """Count a pair of frames."""
        images, seen = warp(earlier, later)
        errors = (images - later.images).square().mean(dim=-1)[:, seen].double()
        total = errors.sum(dim=1).cpu()
        self._errors = total if self._errors is None else self._errors + total
        self._least += float(errors.amin(dim=0).sum())
        self._seen += int(seen.sum())
        self._pixels += seen.numel()

    @property
    def seen(self) -> float:
        """Share of the pixels that both frames of a pair see; 0 without pairs."""
        return self._seen / max(self._pixels, 1)

    def errors(self) -> list[float]:
        """Mean squared error of each method's warped frames; empty without pairs, NaN if no pair shares a pixel."""
        if self._errors is None:
            return []
        return (self._errors / self._seen if self._seen else self._errors * torch.nan).tolist()

    def excess(self) -> list[float]:
        """:meth:`errors` without the least error of each pixel over the methods: the flicker.

        Figures compare only within one call: another set of methods has another least.
        """
        least = self._least / max(self._seen, 1)
        return [error - least for error in self.errors()]
