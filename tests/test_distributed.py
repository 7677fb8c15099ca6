"""Two processes over gloo hold one field: they draw, learn, prune, save and resume as one process does.

This file is both the tests and, started as a program, a rank. Every program has a limit of time, so that nothing hangs.
"""

from __future__ import annotations

import gc
import json
import os
import re
import signal
import subprocess
import sys
import traceback
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn import Parameter

from sundae_ns import checkpoint, distributed
from sundae_ns.data import write_scene
from sundae_ns.densification import CappedStrategy
from sundae_ns.distributed import Course, GlobalPruning, Look, Shards, Timetable, slack_of_step
from sundae_ns.errors import ConfigError, RankError, rank_ended
from sundae_ns.method_configs import sundae_tiny
from sundae_ns.pruning import PruningConfig, make_policy
from sundae_ns.rasterization import rasterize, select_backend, spherical_harmonics
from sundae_ns.rasterization.sharded import Cameras, Slack, camera_row, cameras_of, may_be_seen
from sundae_ns.trainer import SundaeTrainer, SundaeTrainerConfig
from sundae_ns.views import View

RANKS = 2
LIMIT = 600
"""Seconds that a program may take on a busy machine."""
REFERENCE = select_backend("reference", "cpu")
NAMES = ("means", "quats", "scales", "opacities", "features_dc", "features_rest", "features")


def a_field(n: int = 90) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> Tensor:
        return torch.randn(n, *shape, generator=generator, dtype=torch.float64)

    return {
        "means": normal(3) * 0.6,
        "quats": normal(4),
        "scales": normal(3) * 0.4 - 1.8,
        "opacities": normal(1),
        "features_dc": normal(3),
        "features_rest": normal(8, 3) * 0.3,
        "features": normal(5),
    }


def a_view(rank: int) -> View:
    """Cameras that differ in all: place, size and intrinsics."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.4 * rank, -0.1, 2.5])
    width, height, focal = (40, 32, 35.0) if rank == 0 else (24, 48, 28.0)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
    return View(pose, K, width, height, focal)


def colors_of(params: Any, center: Tensor) -> Tensor:
    coeffs = torch.cat([params["features_dc"][:, None], params["features_rest"]], dim=1)
    return (spherical_harmonics(2, params["means"] - center, coeffs, backend=REFERENCE) + 0.5).clamp_min(0)


def draw(params: Any, colors: Tensor, view: View) -> Any:
    return rasterize(
        params["means"],
        params["quats"],
        params["scales"].exp(),
        params["opacities"].sigmoid().squeeze(-1),
        torch.cat([colors, params["features"]], dim=1),
        view.viewmat,
        view.K,
        view.width,
        view.height,
        absgrad=True,
        render_depth=True,
        backend=REFERENCE,
    )


def loss_of(splat: Any, rank: int) -> Tensor:
    weights = torch.randn(splat.colors.shape, generator=torch.Generator().manual_seed(rank), dtype=torch.float64)
    return (splat.colors * weights).mean() + splat.depth.mean() + splat.alpha.square().mean()


def shard_of(params: dict[str, Tensor], start: int, end: int) -> dict[str, Parameter]:
    return {name: Parameter(value[start:end].clone()) for name, value in params.items()}


def check_drawing(shards: Shards) -> None:
    """Pictures, gradients and statistics of two ranks are those of one process for both pictures."""
    start, end = ((0, 60), (60, 90))[shards.rank]
    params = shard_of(a_field(), start, end)
    shards.recount(params)
    assert shards.counts == [60, 30]
    view = a_view(shards.rank)
    arrived = shards.arrivals(params, view, colors_of, near_plane=0.01, features=True)
    assert 0 < len(arrived["means"]) <= 90
    splat = draw(arrived, arrived["colors"], view)
    splat.info["means2d"].retain_grad()
    shards.follow(splat.info, arrived.route, absgrad=True)
    loss_of(splat, shards.rank).backward()
    state = {"grad2d": None, "count": None, "radii": None}
    CappedStrategy(absgrad=True)._update_state(params, state, {"statistics": shards.statistics(splat.info)})

    whole = shard_of(a_field(), 0, 90)
    one = [draw(whole, colors_of(whole, a_view(rank).center), a_view(rank)) for rank in range(RANKS)]
    for splats in one:
        splats.info["means2d"].retain_grad()
    losses = [loss_of(splats, rank) for rank, splats in enumerate(one)]
    (sum(losses) / RANKS).backward()  # type: ignore[union-attr]

    for picture in ("colors", "depth", "alpha"):
        worst = float((getattr(splat, picture) - getattr(one[shards.rank], picture)).abs().max())
        assert worst < 1e-14, f"{picture} differs by {worst:.2g}"
    for name in NAMES:
        expected = whole[name].grad[start:end]
        assert expected.abs().max() > 0, name
        worst = float((params[name].grad - expected).abs().max() / expected.abs().max())
        assert worst < 1e-12, f"{name} differs by {worst:.2g} of the largest gradient"

    # What gsplat's strategy would sum up per primitive over the two pictures, one at a time.
    norms, counts, radii = torch.zeros(90).double(), torch.zeros(90).double(), torch.zeros(90).double()
    for splats, seen_from in zip(one, (a_view(0), a_view(1))):
        halves = torch.tensor([seen_from.width / 2, seen_from.height / 2]).double()
        # The mean of two losses has half the gradient of each, and statistics are of each.
        norms += (splats.info["means2d"].absgrad[0] * halves * RANKS).norm(dim=-1) * (splats.radii > 0)
        counts += splats.radii > 0
        radii = radii.maximum(splats.radii.double() / max(seen_from.width, seen_from.height))
    torch.testing.assert_close(state["grad2d"], norms[start:end].float(), rtol=1e-6, atol=1e-8)
    assert torch.equal(state["count"], counts[start:end].float())
    torch.testing.assert_close(state["radii"], radii[start:end].float())


def check_that_nothing_stays(shards: Shards) -> None:
    """What a step holds goes by itself: Python's collector does not see the cycles that lead through autograd's graph."""
    params = shard_of(a_field(), *distributed.bounds(90, RANKS)[shards.rank : shards.rank + 2])
    shards.recount(params)
    view = a_view(shards.rank)
    arrived = shards.arrivals(params, view, colors_of, near_plane=0.01, features=True)
    splat = draw(arrived, arrived["colors"], view)
    splat.info["means2d"].retain_grad()
    shards.follow(splat.info, arrived.route, absgrad=True)
    timetable: Any = Views(shards.rank)
    shards.plan_ahead(params, timetable, Look(1, 1, 0), Slack(0.1, 0.1))  # and it stays until then
    loss_of(splat, shards.rank).backward()
    shards.statistics(splat.info)
    route = weakref.ref(arrived.route)
    del arrived, splat
    gc.collect()
    assert route() is None
    assert shards.ahead is not None
    shards.forget_plan()


class Views:
    """A timetable in float64: two views, which the ranks take in turns, at half of the size where a look says so."""

    def __init__(self, rank: int) -> None:
        self.rank = rank

    def of(self, look: Look, rank: int) -> View:
        view = a_view((look.step + rank) % RANKS).zoomed(1 / look.downscale)
        aside = torch.zeros(4, 4, dtype=torch.float64)
        aside[0, 3] = 1.2 * ((look.step + rank) % RANKS)  # so that each sees what the other does not
        return view._replace(viewmat=view.viewmat + aside)

    def view(self, look: Look) -> View:
        return self.of(look, self.rank)

    def cameras(self, look: Look) -> Cameras:
        views = [self.of(look, rank) for rank in range(RANKS)]
        return cameras_of(torch.stack([camera_row(v.viewmat, v.K, v.width, v.height, 0.01) for v in views]))


def check_planning_ahead(shards: Shards) -> None:
    """Steps that were planned ahead do what steps that plan at their start do, and what one process does."""
    start, end = distributed.bounds(90, RANKS)[shards.rank : shards.rank + 2]
    views: Any = Views(shards.rank)
    small = {**a_field(), "scales": a_field()["scales"] - 2}
    looks = [Look(step, 1, 0) for step in range(4)]

    def optimizers_of(params: dict[str, Parameter]) -> dict[str, torch.optim.Optimizer]:
        # Rates at which the field leaves its place within three steps.
        return {name: torch.optim.Adam([value], lr=0.1, betas=(0.8, 0.9), eps=1e-8) for name, value in params.items()}

    found = {}
    for ahead in (True, False):
        params = shard_of(small, start, end)
        shards.recount(params)
        optimizers, pictures, missed = optimizers_of(params), [], 0
        for look in looks[:-1]:
            assert (shards.ahead is not None) == (ahead and look.step > 0)
            cameras, route = shards.course(params, views, look)
            assert shards.ahead is None
            view = views.view(look)
            arrived = shards.arrivals(
                params, view, colors_of, near_plane=0.01, features=True, course=Course(cameras, route)
            )
            splat = draw(arrived, arrived["colors"], view)
            pictures.append(splat.colors.detach())
            if ahead:
                slack = slack_of_step(optimizers)
                assert slack is not None
                shards.plan_ahead(params, views, looks[look.step + 1], slack)
                bounds = views.cameras(looks[look.step + 1]).bounds
                before = may_be_seen(params["means"], params["scales"], bounds)
            loss_of(splat, view.width).backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            if ahead:
                missed += int((may_be_seen(params["means"], params["scales"], bounds) & ~before).sum())
        # Without allowing for the steps, something would have been left out.
        every = [count for (count,) in shards.numbers(missed)]
        assert not ahead or sum(every) > 0, every
        found[ahead] = pictures, {name: value.detach() for name, value in params.items()}
        shards.forget_plan()

    whole = shard_of(small, 0, 90)
    optimizers = optimizers_of(whole)
    alone = []
    for look in looks[:-1]:
        drawn = [draw(whole, colors_of(whole, v.center), v) for v in (views.of(look, r) for r in range(RANKS))]
        alone.append(drawn[shards.rank].colors.detach())
        losses = [loss_of(splat, views.of(look, rank).width) for rank, splat in enumerate(drawn)]
        (sum(losses) / RANKS).backward()  # type: ignore[union-attr]
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
    for ours, theirs, expected in zip(found[True][0], found[False][0], alone):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-12)
        torch.testing.assert_close(ours, expected, rtol=0, atol=1e-9)
    for name in NAMES:
        torch.testing.assert_close(found[True][1][name], found[False][1][name], rtol=0, atol=1e-12)
        torch.testing.assert_close(found[True][1][name], whole[name].detach()[start:end], rtol=0, atol=1e-9)


def check_that_plans_are_forgotten(shards: Shards) -> None:
    """A field that has changed, or pictures of another size, are planned for anew, on all ranks; silence is an error."""
    params = shard_of(a_field(), *distributed.bounds(90, RANKS)[shards.rank : shards.rank + 2])
    views: Any = Views(shards.rank)
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}

    def planned() -> bool:
        return shards.ahead is not None

    def plan() -> None:
        shards.plan_ahead(params, views, Look(1, 1, 0), Slack(0.0, 0.0))
        assert planned()

    shards.recount(params)
    plan()
    # Pictures of another size, and another step.
    for look in (Look(1, 2, 0), Look(2, 1, 0)):
        plan()
        cameras, route = shards.course(params, views, look)
        assert not planned()
        expected = views.cameras(look)
        assert torch.equal(cameras.centers, expected.centers)
        assert torch.equal(cameras.bounds, expected.bounds)
        seen = may_be_seen(params["means"], params["scales"], expected.bounds)
        assert torch.equal(torch.stack([route.cameras, route.ids], dim=1), seen.nonzero())
    plan()
    shards.recount(params)
    assert not planned()
    for mask in (None, torch.rand(len(params["means"])) > 0.2):
        plan()
        shards.level(params, optimizers, [], mask)
        assert not planned()
    # Another parameter, other data in the same one, and other values in the same data.
    for change in (
        lambda: params.update(scales=Parameter(params["scales"].data)),
        lambda: setattr(params["scales"], "data", params["scales"].detach().clone()),
        lambda: [params["scales"].detach().mul_(0.5), params["scales"].detach().mul_(2)],
    ):
        plan()
        change()
        with pytest.raises(AssertionError, match="has changed since"):
            shards.course(params, views, Look(1, 1, 0))


def check_looking_away(shards: Shards) -> None:
    """A rank that sees nothing takes its part in the backward pass, and the other learns all the same."""
    params = shard_of(a_field(), *distributed.bounds(90, RANKS)[shards.rank : shards.rank + 2])
    view = a_view(0)
    if shards.rank == 1:
        view = view._replace(viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]).double()) @ view.viewmat)
    arrived = shards.arrivals(params, view, colors_of, near_plane=0.01, features=True)
    assert (len(arrived["means"]) == 0) == (shards.rank == 1)
    splat = draw(arrived, arrived["colors"], view)
    loss_of(splat, 0).backward()
    whole = shard_of(a_field(), 0, 90)
    (loss_of(draw(whole, colors_of(whole, a_view(0).center), a_view(0)), 0) / RANKS).backward()
    start, end = distributed.bounds(90, RANKS)[shards.rank : shards.rank + 2]
    for name in NAMES:
        torch.testing.assert_close(params[name].grad, whole[name].grad[start:end], rtol=1e-10, atol=1e-14)


def check_an_empty_shard(shards: Shards) -> None:
    """Fewer primitives than ranks: who holds none still draws what the other holds, and takes a step."""
    params = shard_of(a_field(), *distributed.bounds(90, RANKS)[shards.rank : shards.rank + 2])
    optimizers = adams(params, 0)
    every = torch.zeros(90, dtype=torch.bool)
    seen = int(draw(a_field(), colors_of(a_field(), a_view(0).center), a_view(0)).radii.argmax())
    every[seen] = True
    shards.level(params, optimizers, [], every[45 * shards.rank : 45 * shards.rank + 45])
    assert shards.counts == [0, 1]
    arrived = shards.arrivals(params, a_view(0), colors_of, near_plane=0.01, features=True)
    splat = draw(arrived, arrived["colors"], a_view(0))
    alone = shard_of(a_field(), seen, seen + 1)
    expected = draw(alone, colors_of(alone, a_view(0).center), a_view(0))
    torch.testing.assert_close(splat.colors, expected.colors)
    loss_of(splat, 0).backward()
    loss_of(expected, 0).backward()
    for name, value in params.items():
        if shards.rank == 1:  # both ranks have the same picture, so the mean is that of one
            torch.testing.assert_close(value.grad, alone[name].grad, rtol=1e-10, atol=1e-14)
        optimizers[name].step()
        assert len(value) == shards.counts[shards.rank]


class Tripling:
    """A strategy that grows the shard of rank 1 alone, and puts a mark on what it has counted."""

    refine_every, grows = 10, True

    def step_post_backward(self, params: Any, optimizers: Any, state: Any, step: int, info: Any) -> None:
        assert len(info["statistics"].norms) > 0
        if dist.get_rank() != 1 or not self.grows:
            return
        for name in list(params):
            params[name] = Parameter(params[name].detach().repeat_interleave(3, dim=0))
            optimizers[name].param_groups[0]["params"] = [params[name]]
        state["count"] = state["count"].repeat_interleave(3)
        state["peak"] = len(params["means"]) + 5  # before it culled


def check_drift(shards: Shards) -> None:
    """Shards that have drifted apart are levelled after a round of densification, in order; the peak is that of all."""
    start, end = ((0, 60), (60, 90))[shards.rank]
    params = shard_of(a_field(), start, end)
    shards.recount(params)
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}
    arrived = shards.arrivals(params, a_view(shards.rank), colors_of, near_plane=0.01, features=True)
    splat = draw(arrived, arrived["colors"], a_view(shards.rank))
    splat.info["means2d"].retain_grad()
    shards.follow(splat.info, arrived.route, absgrad=True)
    loss_of(splat, shards.rank).backward()
    model: Any = SimpleNamespace(
        strategy=Tripling(),
        strategy_state={"count": torch.arange(start, end), "peak": 100},
        config=SimpleNamespace(use_absgrad=True),
        info=splat.info,
        gaussians=params,
        gauss_params=params,
        optimizers=optimizers,
        schedule_step=20,
    )
    planned: Any = object()
    shards.ahead, model.schedule_step = planned, 19
    model.strategy.grows = False
    shards.densify(model)
    assert shards.ahead is planned
    model.schedule_step, model.strategy.grows = 20, True
    shards.densify(model)
    assert shards.ahead is None
    assert shards.counts == [75, 75]
    assert model.strategy_state["peak"] == 60 + 90 + 5
    every = torch.cat([torch.arange(60), torch.arange(60, 90).repeat_interleave(3)])
    own = every[75 * shards.rank : 75 * shards.rank + 75]
    assert torch.equal(model.strategy_state["count"], own)
    assert torch.equal(params["means"], a_field()["means"][own])


def adams(params: dict[str, Parameter], start: int) -> dict[str, torch.optim.Optimizer]:
    """Optimizers whose moments say which row they belong to."""
    made: dict[str, torch.optim.Optimizer] = {}
    for name, value in params.items():
        optimizer = torch.optim.Adam([value], lr=0.1)
        rows = torch.arange(start, start + len(value), dtype=value.dtype).reshape(-1, *[1] * (value.ndim - 1))
        moments = {"exp_avg": rows.expand_as(value).clone(), "exp_avg_sq": (rows + 0.5).expand_as(value).clone()}
        optimizer.state[value] = {"step": torch.tensor(7.0), **moments}
        made[name] = optimizer
    return made


def check_levelling(shards: Shards) -> None:
    """Rows move with their moments and counts, in order, though one rank keeps nothing of its own."""
    whole, start = a_field(), (0, 60)[shards.rank]
    params = shard_of(whole, *((0, 60), (60, 90))[shards.rank])
    optimizers = adams(params, start)
    state: dict[str, Any] = {"grad2d": torch.arange(start, start + len(params["means"])), "radii": None, "scale": 1.0}
    every = torch.zeros(90, dtype=torch.bool)
    every[:60:4] = True  # nothing of rank 1
    shards.level(params, optimizers, [state], every[start : start + len(params["means"])])
    assert shards.counts == [7, 8]
    kept = every.nonzero()[:, 0]
    own = kept[:7] if shards.rank == 0 else kept[7:]
    assert torch.equal(state["grad2d"], own)
    for name, value in params.items():
        assert torch.equal(value, whole[name][own]), name
        (held,) = optimizers[name].param_groups[0]["params"]
        assert held is value
        moments = optimizers[name].state[value]
        assert torch.equal(moments["exp_avg"].flatten(1)[:, 0].long(), own)
        assert torch.equal(moments["exp_avg_sq"].flatten(1)[:, 0], own + 0.5)
        assert float(moments["step"]) == 7
        assert len(optimizers[name].state) == 1


def check_pruning(shards: Shards, **options: Any) -> None:
    """The same primitives stay as on one process, with the same values and moments; NaN goes first."""
    config = PruningConfig(prune_at=1, keep_ratio=0.3, num_neighbors=6, **options)
    whole = a_field(200)
    whole["scales"][150, 1] = torch.nan
    weights = torch.rand(200, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    start, end = ((0, 120), (120, 200))[shards.rank]
    params = shard_of(whole, start, end)
    optimizers, counts = adams(params, start), {"grad2d": torch.arange(start, end)}
    shards.recount(params)
    policy = GlobalPruning(make_policy(config), shards)
    state = policy.policy.initialize_state()

    def contribution() -> Tensor:  # of the finite ones, which have been levelled by then
        return weights[counts["grad2d"]]

    report = policy.step_post_backward(params, optimizers, state, 2, contribution=contribution, strategy_state=counts)

    alone = shard_of(whole, 0, 200)
    own_optimizers, own_counts = adams(alone, 0), {"grad2d": torch.arange(200)}
    own = make_policy(config)
    own_state = own.initialize_state()
    expected = own.step_post_backward(
        alone,
        own_optimizers,
        own_state,
        2,
        contribution=lambda: weights[own_counts["grad2d"]],
        strategy_state=own_counts,
    )
    assert report is not None
    assert expected is not None
    assert (report.before, report.after, report.dropped_nonfinite) == (200, round(0.3 * 199), 1)
    assert report.step == 2 * RANKS + 1
    assert (report.tau, report.sigma, report.peak) == (expected.tau, expected.sigma, expected.peak)
    assert state == own_state
    assert sum(shards.counts) == report.after
    here = slice(sum(shards.counts[: shards.rank]), sum(shards.counts[: shards.rank + 1]))
    assert torch.equal(counts["grad2d"], own_counts["grad2d"][here])
    for name, value in params.items():
        assert torch.equal(value, alone[name][here]), name
        for kind in ("exp_avg", "exp_avg_sq"):
            theirs = own_optimizers[name].state[alone[name]][kind][here]
            assert torch.equal(optimizers[name].state[value][kind], theirs), (name, kind)


def check_refusal(shards: Shards) -> None:
    """What rank 0 finds wrong, all ranks say."""
    params = shard_of(a_field(), *distributed.bounds(90, RANKS)[shards.rank : shards.rank + 2])
    shards.recount(params)
    policy = GlobalPruning(make_policy(PruningConfig(prune_at=1, keep_ratio=0.3)), shards)
    with pytest.raises(ConfigError, match="pass over the training views"):
        policy.step_post_backward(params, {}, policy.policy.initialize_state(), 2)


def check_averages(shards: Shards) -> None:
    values = [torch.zeros(3, requires_grad=True), torch.zeros(2, 2, requires_grad=True), torch.zeros(1)]
    for value in values[:2]:
        value.grad = torch.full_like(value, float(shards.rank + 1))
    distributed.average_gradients(values)
    assert all((value.grad == 1.5).all() for value in values[:2])  # type: ignore[union-attr]
    assert shards.announce({"rank": shards.rank}) == {"rank": 0}
    assert shards.apart(values) == 0
    with torch.no_grad():
        values[1][1, 0] -= 0.25 * shards.rank
    assert shards.apart(values) == 0.25
    assert shards.apart([]) == 0


# ----------------------------------------------------------------------------------------------------------- training


STEPS, KEEP, PRUNE_AT, SAVE_EVERY = 40, 0.4, 32, 26
SAVED_AT = SAVE_EVERY + RANKS - 1
"""Two ranks save after batch 13, which is the last that sees picture 27."""


def configured(folder: Path, name: str) -> SundaeTrainerConfig:
    """A short run on a small scene: it densifies at picture 24, prunes at 32, and then the head takes part."""
    import copy

    config = copy.deepcopy(sundae_tiny.config)
    assert isinstance(config, SundaeTrainerConfig)
    config.machine.device_type = "cpu"
    config.machine.num_devices = RANKS
    config.output_dir, config.experiment_name, config.timestamp = folder, name, "now"
    config.max_num_iterations, config.steps_per_save, config.steps_per_eval_image = STEPS, SAVE_EVERY, 10
    config.save_only_latest_checkpoint = False
    config.vis = "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.pipeline.datamanager.data = folder / "scene"
    model: Any = config.pipeline.model
    model.rasterizer = "reference"
    model.pruning.prune_at, model.pruning.keep_ratio = PRUNE_AT, KEEP
    model.warmup_length, model.refine_every, model.stop_split_at = 4, 6, PRUNE_AT
    model.num_downscales, model.resolution_schedule = 1, 4
    model.densify_grad_thresh, model.reset_alpha_every, model.sh_degree_interval = 0.003, 100, 8
    return config


def frozen(folder: Path, name: str) -> SundaeTrainerConfig:
    """One step at rates of 0 from the saved warm-up, and a prune: the field that is pruned is the same for any ranks."""
    config = configured(folder, name)
    config.max_num_iterations = 1
    config.steps_per_eval_image = 1000
    model: Any = config.pipeline.model
    model.warm_start = folder / "train" / "sundae-tiny" / "now" / "nerfstudio_models" / f"step-{SAVED_AT:09d}.ckpt"
    model.evaluate_prune = False
    for group in config.optimizers.values():
        group["optimizer"].lr, group["scheduler"] = 0.0, None
    return config


def train(config: SundaeTrainerConfig, rank: int, ranks: int) -> SundaeTrainer:
    from nerfstudio.utils import profiler, writer

    torch.manual_seed(config.machine.seed + rank)
    trainer: SundaeTrainer = config.setup(local_rank=rank, world_size=ranks)
    trainer.setup()
    trainer.train()
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    profiler.PROFILER.clear()
    return trainer


def check_training(shards: Shards, folder: Path) -> None:
    """A run of two ranks; afterwards both have the same head, and no shard is far from the mean."""
    anew = []
    course = Shards.course

    def noted(self: Shards, params: Any, timetable: Timetable, look: Look) -> Course:
        if self.ahead is None or self.ahead.look != look:
            anew.append(look.step)
        return course(self, params, timetable, look)

    Shards.course = noted  # type: ignore[method-assign]
    trainer = train(configured(folder, "train"), shards.rank, RANKS)
    Shards.course = course  # type: ignore[method-assign]
    # The first step, those after a round of growing, and the one after the prune; resolution rises at step 2.
    assert anew == [0, *range(1, PRUNE_AT // RANKS + 1, 3), PRUNE_AT // RANKS + 1]
    model: Any = trainer.pipeline.model
    weights = torch.cat([value.detach().flatten() for value in model.head.parameters()])
    every = [torch.empty_like(weights) for _ in range(RANKS)]
    dist.all_gather(every, weights)
    assert torch.equal(every[0], every[1])
    assert model.shards.numbers(model.num_points) == [[count] for count in model.shards.counts]
    assert max(model.shards.counts) <= distributed.DRIFT * model.total_points / RANKS
    group = trainer.optimizers.optimizers["opacities"].param_groups[0]
    assert group["lr"] == pytest.approx(0.05 * RANKS**0.5)
    assert group["betas"] == pytest.approx((0.9**RANKS, 0.999**RANKS))
    head = trainer.optimizers.optimizers["compensation"].param_groups[0]
    assert (head["initial_lr"], head["betas"]) == (
        sundae_tiny.config.optimizers["compensation"]["optimizer"].lr,
        (0.9, 0.999),
    )


def check_frozen(shards: Shards, folder: Path) -> None:
    train(frozen(folder, "two"), shards.rank, RANKS)


CHECKS: tuple[Callable[..., None], ...] = (
    check_drawing,
    check_that_nothing_stays,
    check_planning_ahead,
    check_that_plans_are_forgotten,
    check_looking_away,
    check_levelling,
    check_an_empty_shard,
    check_drift,
    check_pruning,
    partial(check_pruning, redistribution="none", score="response-contribution", selection="top"),
    check_refusal,
    check_averages,
)


@dataclass
class DyingTrainerConfig(SundaeTrainerConfig):
    """A run whose rank 1 is killed."""

    _target: type = field(default_factory=lambda: DyingTrainer)


class DyingTrainer(SundaeTrainer):
    """Killed at a step, as by the system where memory is short."""

    def train_iteration(self, step: int) -> Any:
        if step == (SAVED_AT + 1) // RANKS + 2 and dist.get_rank() == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().train_iteration(step)


def main(role: str, folder: Path) -> None:
    torch.set_num_threads(1)
    if role == "dies":
        plain = configured(folder, "dies")
        config = DyingTrainerConfig(**{k: v for k, v in vars(plain).items() if k != "_target"})
        config.load_checkpoint = (
            folder / "train" / "sundae-tiny" / "now" / "nerfstudio_models" / f"step-{SAVED_AT:09d}.ckpt"
        )
        try:
            distributed.launch(config, RANKS)
        except RankError as error:
            (folder / "died.txt").write_text(str(error))
        return
    rank = int(role)
    dist.init_process_group("gloo", init_method=f"file://{folder / 'meeting'}", rank=rank, world_size=RANKS)
    shards = Shards("cpu")
    said = {}
    for check in (*CHECKS, partial(check_training, folder=folder), partial(check_frozen, folder=folder)):
        name = getattr(check, "func", check).__name__ + str(getattr(check, "keywords", {}).get("score", ""))
        try:
            check(shards)
            said[name] = ""
        except BaseException:
            said[name] = traceback.format_exc()
            break  # the other rank may wait for this one
    (folder / f"rank{rank}.json").write_text(json.dumps(said))
    if not any(said.values()):
        dist.barrier()
        dist.destroy_process_group()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))


# -------------------------------------------------------------------------------------------------------------- tests


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where two ranks have gone through all checks, once for all tests."""
    folder = tmp_path_factory.mktemp("ranks")
    write_scene(folder / "scene", train_views=7, test_views=2, width=40, height=32, points=150)
    programs = [subprocess.Popen([sys.executable, __file__, str(rank), str(folder)]) for rank in range(RANKS)]
    try:
        for program in programs:
            program.wait(LIMIT)
    except subprocess.TimeoutExpired:
        pass  # what is missing then fails by name
    finally:
        for program in programs:
            program.kill()
            program.wait()
    return folder


def names_of_checks() -> list[str]:
    every = [*CHECKS, check_training, check_frozen]
    return [getattr(c, "func", c).__name__ + str(getattr(c, "keywords", {}).get("score", "")) for c in every]


@pytest.mark.parametrize("name", names_of_checks())
def test_two_ranks(folder: Path, name: str) -> None:
    for rank in range(RANKS):
        path = folder / f"rank{rank}.json"
        assert path.exists(), f"rank {rank} did not come to an end"
        said = json.loads(path.read_text())
        assert said.get(name, "not reached") == "", f"rank {rank}: {said.get(name)}"


def models(folder: Path, name: str) -> Path:
    return folder / name / "sundae-tiny" / "now" / "nerfstudio_models"


def test_checkpoint_of_two_ranks_is_one_of_one_gpu(folder: Path) -> None:
    (report,) = json.loads((models(folder, "train").parent / "prune.json").read_text())
    assert report["step"] == PRUNE_AT + RANKS - 1
    assert report["after"] == round(KEEP * report["before"])
    assert report["before"] > 150, "densification added nothing"
    before, after = (
        checkpoint.load(models(folder, "train") / f"step-{step:09d}.ckpt") for step in (SAVED_AT, STEPS - 1)
    )
    assert len(after["pipeline"]["_model.gauss_params.means"]) == report["after"]
    n = len(before["pipeline"]["_model.gauss_params.means"])
    assert len(before["pipeline"]["_model._extra_state"]["strategy"]["grad2d"]) == n
    for name in NAMES[:-1]:
        (moments,) = before["optimizers"][name]["state"].values()
        assert len(moments["exp_avg"]) == n
    group = after["optimizers"]["opacities"]["param_groups"][0]
    assert group["lr"] == pytest.approx(0.05, rel=1e-12)
    assert tuple(group["betas"]) == (0.9, 0.999)
    extra = after["pipeline"]["_model._extra_state"]
    assert extra["trained_focal"] is not None
    assert (after["step"], extra["step"], extra["pruning"]["pruned_at"]) == (STEPS - 1, STEPS - 1, report["step"])
    schedule = after["schedulers"]["means"]
    assert schedule["last_epoch"] == STEPS
    assert schedule["base_lrs"] == pytest.approx([1.6e-4])
    assert schedule["lr_lambdas"][0]["max_steps"] == sundae_tiny.config.optimizers["means"]["scheduler"].max_steps
    assert schedule["lr_lambdas"][0]["pruned_at"] == report["step"]


def test_the_prune_is_that_of_one_process(folder: Path) -> None:
    """From the same field, views and all: the same primitives stay, with the same values."""
    one = train(frozen(folder, "one"), 0, 1)
    two = checkpoint.load(models(folder, "two") / "step-000000001.ckpt")["pipeline"]
    for name, value in one.pipeline.model.gauss_params.items():
        # Weights of a view are sums over fewer rows here, so that what a merge makes of them differs by rounding.
        torch.testing.assert_close(value.detach(), two[f"_model.gauss_params.{name}"], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("ranks", [1, 3])
def test_a_checkpoint_loads_on_another_number_of_ranks(folder: Path, ranks: int) -> None:
    loaded = checkpoint.load(models(folder, "train") / f"step-{SAVED_AT:09d}.ckpt")
    parts = [distributed.state_of_rank(loaded, rank, ranks, NAMES) for rank in range(ranks)]
    for key, value in loaded["pipeline"].items():
        if key.startswith("_model.gauss_params."):
            assert torch.equal(torch.cat([part["pipeline"][key] for part in parts]), value)
    counts = loaded["pipeline"]["_model._extra_state"]["strategy"]["count"]
    theirs = [part["pipeline"]["_model._extra_state"]["strategy"]["count"] for part in parts]
    assert torch.equal(torch.cat(theirs), counts)
    group, whole = (x["optimizers"]["means"]["param_groups"][0] for x in (parts[0], loaded))
    assert group["lr"] == pytest.approx(whole["lr"] * ranks**0.5)
    assert group["betas"] == pytest.approx([beta**ranks for beta in whole["betas"]])
    assert parts[0]["optimizers"]["compensation"] == loaded["optimizers"]["compensation"]
    assert parts[0]["schedulers"]["compensation"]["base_lrs"] == loaded["schedulers"]["compensation"]["base_lrs"]
    assert parts[0]["step"] == (SAVED_AT + 1) // ranks - 1
    assert parts[0]["schedulers"]["means"]["last_epoch"] == round((SAVED_AT + 1) / ranks)


def test_a_checkpoint_of_another_method_is_left_to_the_loader() -> None:
    """Which names the method and the option; the ranks' own part of it would fail on the first missing key."""
    loaded = {"step": 3, "pipeline": {"_model.gauss_params.means": torch.zeros(4, 3)}, "optimizers": {}}
    assert distributed.state_of_rank(loaded, 1, 2, NAMES) == loaded


def test_one_process_goes_on_where_two_have_stopped(folder: Path) -> None:
    config = configured(folder, "alone")
    config.load_checkpoint = models(folder, "train") / f"step-{SAVED_AT:09d}.ckpt"
    config.max_num_iterations = PRUNE_AT - SAVED_AT + 1
    trainer = train(config, 0, 1)
    assert trainer.optimizers.optimizers["opacities"].param_groups[0]["lr"] == pytest.approx(0.05)
    (report,) = json.loads((models(folder, "alone").parent / "prune.json").read_text())
    assert (report["step"], report["after"]) == (PRUNE_AT, round(KEEP * report["before"]))
    assert trainer.optimizers.schedulers["means"].last_epoch == trainer.step + 1


def test_a_killed_rank_ends_all_with_one_line(folder: Path) -> None:
    """It resumes on two ranks first, from what two have saved."""
    subprocess.run([sys.executable, __file__, "dies", str(folder)], timeout=LIMIT, check=True)
    line = (folder / "died.txt").read_text()
    assert re.fullmatch(r"rank 1 has ended \(killed by SIGKILL\).*--load-dir.*--machine\.num-devices", line)
    assert not (models(folder, "dies") / f"step-{SAVED_AT + STEPS:09d}.ckpt").exists()


@pytest.mark.gpu
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_ns_train_on_two_gpus(tmp_path: Path) -> None:
    """The command of users; the run opens on one GPU as any other."""
    from nerfstudio.utils.eval_utils import eval_setup

    write_scene(tmp_path / "scene", train_views=12, test_views=3, width=64, height=48, points=300)
    options = {
        "machine.num-devices": 2,
        "data": tmp_path / "scene",
        "output-dir": tmp_path,
        "experiment-name": "gpus",
        "timestamp": "now",
        "max-num-iterations": 240,
        "pipeline.model.pruning.prune-at": 120,
        "pipeline.model.pruning.keep-ratio": KEEP,
        "pipeline.model.warmup-length": 10,
        "pipeline.model.refine-every": 30,
        "viewer.quit-on-train-completion": True,
    }
    words = [str(word) for name, value in options.items() for word in (f"--{name}", value)]
    program = [sys.executable, "-m", "nerfstudio.scripts.train"]
    subprocess.run([*program, "sundae-tiny", *words], timeout=2 * LIMIT, check=True, cwd=tmp_path)
    run = tmp_path / "gpus" / "sundae-tiny" / "now"
    (report,) = json.loads((run / "prune.json").read_text())
    assert report["after"] == round(KEEP * report["before"])
    _, pipeline, _, step = eval_setup(run / "config.yml", test_mode="test")
    assert step == 239
    assert pipeline.model.num_points == report["after"]
    # 16 dB is far above a field that has not learned, and far below one that has.
    assert pipeline.get_average_eval_image_metrics()["psnr"] > 16


def test_an_error_of_ours_in_a_rank_is_said_as_it_is() -> None:
    class Raised(Exception):
        error_index = 1

    text = "\n\n-- Process 1 terminated with the following error:\nTraceback ...\nsundae_ns.errors.DataError: cause; mend\n"
    assert str(rank_ended(Raised(text))) == "rank 1: cause; mend"
    assert "rank 1 has ended (ValueError: odd)" in str(rank_ended(Raised("Traceback ...\nValueError: odd")))


def test_nerfstudios_command_ends_with_one_line() -> None:
    code = """
import sys
sys.argv = ["/usr/bin/ns-train"]
from torch.multiprocessing.spawn import ProcessExitedException
from sundae_ns.errors import show_in_one_line
show_in_one_line()
raise ProcessExitedException("process 1 terminated with signal SIGKILL", 1, 7, -9, "SIGKILL")
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT, check=False)
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("sundae: rank 1 has ended (killed by SIGKILL)")


@pytest.mark.parametrize(("total", "ranks"), [(10, 3), (2, 4), (0, 2), (9, 1)])
def test_blocks_cover_all_rows_and_differ_by_one(total: int, ranks: int) -> None:
    ends = distributed.bounds(total, ranks)
    sizes = [b - a for a, b in zip(ends, ends[1:])]
    assert (ends[0], ends[-1]) == (0, total)
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize(
    ("option", "value"), [("warmup", "mcmc"), ("pruning.mode", "auto"), ("camera_optimizer.mode", "SO3xR3")]
)
def test_what_several_ranks_cannot_do_is_refused(tmp_path: Path, option: str, value: str) -> None:
    config = configured(tmp_path, "refused")
    *owners, name = option.split(".")
    owner: Any = config.pipeline.model
    for part in owners:
        owner = getattr(owner, part)
    setattr(owner, name, value)
    with pytest.raises(ConfigError, match="several GPUs"):
        distributed.check_options(config)


def test_more_ranks_than_gpus_are_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = configured(tmp_path, "refused")
    with pytest.raises(ConfigError, match="needs GPUs.*device-type is cpu"):
        config.save_config()
    config.machine.device_type = "cuda"
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ConfigError, match="is 2 and there are 1 GPUs; give --machine.num-devices 1"):
        config.save_config()
    assert not config.get_base_dir().exists()
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    config.save_config()
    assert (config.get_base_dir() / "config.yml").exists()


def test_shorter_runs_see_as_many_pictures(tmp_path: Path) -> None:
    config = configured(tmp_path, "short")
    short = distributed.shorten(config, 2)
    assert (short.max_num_iterations, config.max_num_iterations) == (STEPS // 2, STEPS)
    assert short.pipeline.model.pruning.prune_at == PRUNE_AT // 2
    assert short.pipeline.model.refine_every == 3
    full = config.optimizers["means"]["scheduler"].max_steps
    assert short.optimizers["means"]["scheduler"].max_steps == full // 2


def test_loggers_stay_when_the_viewer_goes() -> None:
    assert [distributed.without_viewer(vis) for vis in ("viewer", "viewer+wandb", "comet")] == [
        "tensorboard",
        "wandb",
        "comet",
    ]
