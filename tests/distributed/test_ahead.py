"""What a step knows of the next one: the views of all ranks, and a bound on the step of Adam."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from hypothesis import given
from hypothesis import strategies as st
from nerfstudio.cameras.cameras import Cameras
from pytorch_msssim import SSIM
from torch.nn import Parameter

from sundae_ns.compensation import training_window
from sundae_ns.distributed import ShardedField, Shards
from sundae_ns.distributed.ahead import Timetable, longest_step, slack_of_step
from sundae_ns.distributed.source import send_statistics, statistics_of
from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import rasterize, select_backend
from sundae_ns.rasterization.sharded import camera_row
from sundae_ns.rendering import ColorSettings, StepResolution, view_of
from sundae_ns.rendering.source import NEAR_PLANE
from sundae_ns.training.densification import CappedStrategy
from sundae_ns.training.losses import image_losses

RATE = 0.01


@given(
    seed=st.integers(0, 10**6),
    ranks=st.sampled_from([1, 2, 4, 16]),
    growth=st.floats(0.5, 2.0),
    sparsity=st.sampled_from([0.0, 0.5, 0.95]),
)
def test_no_step_of_adam_is_longer(seed: int, ranks: int, growth: float, sparsity: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    value = Parameter(torch.zeros(200, dtype=torch.float64))
    optimizer = torch.optim.Adam([value], lr=RATE, betas=(0.9**ranks, 0.999**ranks), eps=1e-15)
    most = longest_step(optimizer)
    for step in range(30):
        gradient = torch.randn(200, generator=generator, dtype=torch.float64) * growth**step
        value.grad = gradient * (torch.rand(200, generator=generator) >= sparsity)
        before = value.detach().clone()
        optimizer.step()
        assert (value.detach() - before).abs().max() <= most
        optimizer.state[value]["exp_avg"][step::50] = 0  # as after a merge or a split
        optimizer.state[value]["exp_avg_sq"][step::100] = 0 if step % 3 else 1.0


@pytest.mark.parametrize("betas", [(0.9, 0.999), (0.81, 0.998001), (0.5, 0.5)])
def test_growing_gradients_come_near_the_bound(betas: tuple[float, float]) -> None:
    """So no shorter bound holds; the learning rate alone is far too short."""
    value = Parameter(torch.zeros((), dtype=torch.float64))
    optimizer = torch.optim.Adam([value], lr=RATE, betas=betas, eps=0.0)
    before = 0.0
    for step in range(-6000, 1):  # until the bias correction of the moments has faded
        value.grad = torch.tensor((betas[1] / betas[0]) ** max(step, -200), dtype=torch.float64)
        before = value.item()
        optimizer.step()
    assert 0.97 * longest_step(optimizer) < abs(value.item() - before) <= longest_step(optimizer)


def test_other_optimizers_are_not_planned_for() -> None:
    value = Parameter(torch.zeros(3))
    others = (
        torch.optim.AdamW([value]),
        torch.optim.SGD([value]),
        torch.optim.Adam([value], betas=(0.9, 0.5)),
    )
    assert all(math.isinf(longest_step(other)) for other in others)
    adam = torch.optim.Adam([value], lr=RATE)
    assert slack_of_step({"means": others[0], "scales": adam}) is None
    slack = slack_of_step({"means": adam, "scales": torch.optim.Adam([value], lr=2 * RATE)})
    assert slack is not None
    assert slack.scales == pytest.approx(2 * slack.means)


def test_the_timetable_knows_the_views_of_all_ranks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dist, "get_world_size", lambda: 3)
    poses = torch.randn(5, 3, 4, generator=torch.Generator().manual_seed(0))
    sides = torch.tensor([[64], [48], [64], [32], [80]])
    cameras = Cameras(poses, 50.0, 40.0, 33.0, 20.0, width=sides, height=sides - 10)
    timetable = Timetable(cameras, lambda image: (2 * image) % 5, "cpu")
    for at in (
        StepResolution(0, 1, 0),
        StepResolution(1, 1, 0),
        StepResolution(1, 2, 0),
        StepResolution(2, 1, 1024),
        StepResolution(3, 1, 1024),
        StepResolution(4, 1, 1024, mirror=True),
        StepResolution(5, 1, 0, mirror=True),
    ):
        indices = [(2 * (3 * at.step + rank)) % 5 for rank in range(3)]
        assert timetable.views(at.step) == indices
        views = [view_of(cameras[i : i + 1], "cpu", downscale=at.downscale) for i in indices]
        known = timetable.cameras(at)
        for rank, view in enumerate(views):
            window = training_window(view.width, view.height, at.window_pixels, seed=at.step, mirror=at.mirror)
            seen = view if window is None else view.cut(window)
            row = camera_row(seen.viewmat, seen.K, seen.width, seen.height, NEAR_PLANE)
            assert torch.equal(torch.cat([known.centers[rank], known.bounds[rank].flatten()]), row)


@pytest.mark.gpu
def test_a_step_waits_for_the_gpu_only_while_it_splats(tmp_path: Path) -> None:
    """torch raises where it would wait. One rank suffices, so this runs on any machine with a GPU."""
    learn(tmp_path, "cuda", "nccl", partial(torch.cuda.set_sync_debug_mode, "error"))


def learn(folder: Path, device: str, group: str, forbid_waits: Callable[[], None]) -> None:
    """Three steps of a single rank; from the second on, its exchange is planned ahead."""
    generator = torch.Generator().manual_seed(0)
    shapes = {
        "means": (3,),
        "quats": (4,),
        "scales": (3,),
        "opacities": (1,),
        "features_dc": (3,),
        "features_rest": (3, 3),
    }
    params = {
        name: Parameter(torch.randn(500, *shape, generator=generator).mul(0.5).to(device))
        for name, shape in shapes.items()
    }
    params["scales"].data -= 3
    optimizers = {name: torch.optim.Adam([value], fused=True) for name, value in params.items()}
    pose = torch.eye(4)[None, :3].clone()
    pose[0, 2, 3] = 3.0
    cameras = Cameras(pose, 60.0, 60.0, 32.0, 24.0, width=64, height=48)
    backend = select_backend("auto", device)
    strategy, ssim, target = CappedStrategy(absgrad=True), SSIM(data_range=1.0), torch.rand(48, 64, 3).to(device)
    state = strategy.initialize_state()
    dist.init_process_group(group, init_method=f"file://{folder / 'meeting'}", rank=0, world_size=1)
    try:
        shards = Shards(device)
        source = ShardedField(shards, Field(params), Timetable(cameras, lambda image: 0, device))
        shards.recount(params)
        view = view_of(cameras, device)
        for step in range(3):
            at = StepResolution(step, 1, 0)
            assert (source._planned is not None) == (step > 0)
            if step > 0:  # in the first step kernels load, constants are made, and the ranks meet
                forbid_waits()
            received = source.primitives(view, ColorSettings(backend), features=False, at=at)
            allow_waits()
            splat = rasterize(
                received["means"],
                received["quats"],
                received["scales"].exp(),
                received["opacities"].sigmoid()[:, 0],
                received["colors"],
                *view[:4],
                absgrad=True,
                backend=backend,
            )
            if step > 0:
                forbid_waits()
            splat.info["means2d"].retain_grad()
            splat.info["route"] = received.route
            send_statistics(splat.info, absgrad=True)
            source.plan_next(StepResolution(step + 1, 1, 0), optimizers)
            image_losses(splat.colors, None, target, ssim, 0.2)[0].backward()  # type: ignore[no-untyped-call]
            strategy._update_state(params, state, {"statistics": statistics_of(splat.info)})
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            allow_waits()
        assert state["grad2d"].sum() > 0
        assert state["count"].max() == 3
    finally:
        allow_waits()
        dist.destroy_process_group()


def allow_waits() -> None:
    if torch.cuda.is_available():
        torch.cuda.set_sync_debug_mode("default")
