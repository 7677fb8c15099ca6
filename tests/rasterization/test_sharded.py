"""Visibility of primitives to a camera: never fewer than the rasteriser renders, and not many more."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from splat_inputs import geometry
from torch import Tensor

from sundae_ns.rasterization.reference import project
from sundae_ns.rasterization.sharded import UNMOVED, Slack, frustum_bounds, may_be_seen

NEAR = 0.01


def scattered(seed: int, n: int = 4000) -> tuple[Tensor, Tensor, Tensor]:
    """Centres all around a camera at the origin, some of them very near; sizes over four decades; rotations."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(n, 3, generator=generator) * torch.rand(n, 1, generator=generator).exp2().pow(3)
    means[: n // 8, 2] *= 0.01
    scales = torch.randn(n, 3, generator=generator).mul(1.5).sub(3).exp()
    return means, torch.randn(n, 4, generator=generator), scales


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("width", "height", "focal", "cx", "most"), [(64, 48, 50.0, 32.0, 2), (300, 20, 20.0, -40.0, 6)]
)
def test_all_rendered_primitives_may_be_seen(
    seed: int, width: int, height: int, focal: float, cx: float, most: float
) -> None:
    means, quats, scales = scattered(seed)
    K = torch.tensor([[focal, 0.0, cx], [0.0, 1.5 * focal, height / 2], [0.0, 0.0, 1.0]])
    drawn = project(geometry(means, quats, scales, torch.eye(4), K, width, height)).radii > 0
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    bounds = torch.stack([frustum_bounds(pose, K, width, height, NEAR) for pose in (away, torch.eye(4))])
    unseen, seen = may_be_seen(means, scales.log(), bounds)
    assert not (drawn & unseen).any()  # bounds of one camera do not affect the other
    assert drawn.any()
    assert not (drawn & ~seen).any()
    # Looser bounds would send the whole field; these primitives are far larger and nearer than those of a scene.
    assert seen.sum() < most * drawn.sum()


@given(
    seed=st.integers(0, 10**6),
    means_slack=st.sampled_from([0.0, 1e-6, 1e-3, 0.03, 1.0]),
    scales_slack=st.sampled_from([0.0, 1e-5, 0.01, 0.1, 2.0]),
    towards=st.booleans(),
)
def test_primitives_rendered_after_a_move_may_be_seen_before_it(
    seed: int, means_slack: float, scales_slack: float, towards: bool
) -> None:
    generator = torch.Generator().manual_seed(seed)
    means, quats, scales = scattered(seed, 2000)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation * rotation.det(), torch.randn(3, generator=generator) * 0.3
    K = torch.tensor([[60.0, 0.0, 20.0], [0.0, 45.0, 30.0], [0.0, 0.0, 1.0]])
    bounds = frustum_bounds(pose, K, 64, 48, NEAR)[None]
    seen = may_be_seen(means, scales.log(), bounds, Slack(means_slack, scales_slack))[0]
    if towards:  # the largest allowed move towards one of the five planes, and the largest allowed scale
        plane = torch.randint(0, 5, (len(means),), generator=generator)
        moved = means - means_slack * bounds[0, plane, :3].sign()
        grown = scales.log() + scales_slack
    else:
        moved = means + means_slack * (2 * torch.rand(means.shape, generator=generator) - 1)
        grown = scales.log() + scales_slack * (2 * torch.rand(scales.shape, generator=generator) - 1)
    drawn = project(geometry(moved, quats, grown.exp(), pose, K, 64, 48)).radii > 0
    assert not (drawn & ~seen).any()


def test_slack_adds_few_primitives() -> None:
    means, _, scales = scattered(3)
    K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
    bounds = frustum_bounds(torch.eye(4), K, 64, 48, NEAR)[None]
    exact, wider = (may_be_seen(means, scales.log(), bounds, slack).sum() for slack in (UNMOVED, Slack(0.002, 0.05)))
    assert exact < wider < 1.03 * exact


def test_nan_depth_is_not_seen() -> None:
    means = torch.tensor([[0.0, 0.0, 2.0], [torch.nan, 0.0, 2.0], [0.0, 0.0, torch.nan], [0.0, 0.0, 0.0]])
    scales = torch.full((4, 3), 0.1)
    drawn = project(geometry(means, torch.ones(4, 4), scales, torch.eye(4), torch.eye(3), 10, 10)).radii > 0
    (seen,) = may_be_seen(means, scales.log(), frustum_bounds(torch.eye(4), torch.eye(3), 10, 10, NEAR)[None])
    assert drawn.tolist()[0]
    assert not (drawn & ~seen).any()
    assert not seen[2:].any()
