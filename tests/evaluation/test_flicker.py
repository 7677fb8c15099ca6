"""Change between frames: near zero if only the camera moves, larger if the image flickers."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sundae_ns.evaluation import Frame, change

H, W = 48, 64
K = torch.tensor([[60.0, 0.0, W / 2], [0.0, 60.0, H / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)


def slanted_plane(shift: float, turn: float = 0.0, noise: float = 0.0, front: bool = False) -> Frame:
    """A smooth texture on the plane z = 4 + 0.3 x, seen by a camera that moves to the right and turns."""
    viewmat = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(turn), math.sin(turn)
    viewmat[:3, :3] = torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([shift, 0.0, 0.0], dtype=torch.float64)
    y, x = torch.meshgrid(torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij")
    rays = torch.stack([(x - W / 2) / 60, (y - H / 2) / 60, torch.ones_like(x)], dim=-1).double()
    world = rays @ viewmat[:3, :3]  # directions, rotated back
    origin = torch.tensor([shift, 0.0, 0.0], dtype=torch.float64)
    depth = (4 + 0.3 * origin[0]) / (world[..., 2] - 0.3 * world[..., 0])
    point = origin + depth[..., None] * world
    rgb = 0.5 + 0.3 * torch.stack([point[..., 0], point[..., 1], point[..., 0] + point[..., 1]], dim=-1).sin()
    if front:  # a grey card in front of the plane
        depth[10:30, 20:40] = 2.0
        rgb[10:30, 20:40] = 0.5
    generator = torch.Generator().manual_seed(round(1e6 * shift))
    rgb = rgb + noise * torch.randn(rgb.shape, generator=generator, dtype=torch.float64)
    return Frame(rgb, depth[..., None], torch.ones(H, W, 1, dtype=torch.float64), viewmat, K)


def test_camera_motion_alone_is_no_change() -> None:
    still = change(slanted_plane(0.0), slanted_plane(0.1, turn=-0.02))
    assert still.mean < 1e-3  # error of bilinear sampling
    assert still.share > 0.8
    # Without the warp the same two frames differ a lot.
    assert (slanted_plane(0.0).rgb - slanted_plane(0.1, turn=-0.02).rgb).abs().mean() > 1e-2


def test_flicker_is_measured() -> None:
    amounts = [change(slanted_plane(0.0, noise=n), slanted_plane(0.1, noise=n)).mean for n in (0.0, 0.02, 0.04)]
    assert amounts[0] < 0.3 * amounts[1] < 0.3 * amounts[2]
    assert amounts[2] == pytest.approx(2 * amounts[1], rel=0.1)


def test_disoccluded_surfaces_do_not_count() -> None:
    """Behind the card, the earlier frame has another depth."""
    covered = change(slanted_plane(0.0, front=True), slanted_plane(0.02))
    plain = change(slanted_plane(0.0), slanted_plane(0.02))
    assert covered.share < plain.share - 0.9 * 400 / (H * W)
    assert covered.mean < 5e-3


def test_frames_without_common_pixels() -> None:
    frame: Tensor = slanted_plane(0.0).viewmat
    away = slanted_plane(0.0)._replace(accumulation=torch.zeros(H, W, 1, dtype=frame.dtype))
    nothing = change(slanted_plane(0.0), away)
    assert nothing.share == 0
    assert math.isnan(nothing.mean)
