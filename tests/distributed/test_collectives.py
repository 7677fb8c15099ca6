"""Two processes over gloo hold one field: they draw, plan, level and prune as one process does.

This file has the checks, which ``rank.py`` goes through on each rank, and the tests that see what came of them.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn import Parameter

from sundae_ns import distributed
from sundae_ns.distributed import Course, GlobalPruning, Look, Shards, slack_of_step
from sundae_ns.errors import ConfigError
from sundae_ns.pruning import PruningConfig
from sundae_ns.rasterization import rasterize, select_backend, spherical_harmonics
from sundae_ns.rasterization.sharded import Cameras, Slack, camera_row, cameras_of, may_be_seen
from sundae_ns.rendering.views import View
from sundae_ns.training.densification import CappedStrategy
from sundae_ns.training.schedules import make_policy

RunRanks = Callable[[str, Path], None]
Passed = Callable[[Path, str], None]
RANKS = 2
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
    views: Any = Views(shards.rank)
    shards.timetable = views
    shards.plan_ahead(params, Look(1, 1, 0), Slack(0.1, 0.1))  # and it stays until then
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
    shards.timetable = views
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
            cameras, route = shards.course(params, look)
            assert shards.ahead is None
            view = views.view(look)
            arrived = shards.arrivals(
                params, view, colors_of, near_plane=0.01, features=True, course=Course(cameras, route)
            )
            splat = draw(arrived, arrived["colors"], view)
            pictures.append(splat.colors.detach())
            if ahead:
                shards.plan_ahead(params, looks[look.step + 1], slack_of_step(optimizers))
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
    shards.timetable = views
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}

    def planned() -> bool:
        return shards.ahead is not None

    def plan() -> None:
        shards.plan_ahead(params, Look(1, 1, 0), Slack(0.0, 0.0))
        assert planned()

    shards.recount(params)
    plan()
    # Pictures of another size, and another step.
    for look in (Look(1, 2, 0), Look(2, 1, 0)):
        plan()
        cameras, route = shards.course(params, look)
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
            shards.course(params, Look(1, 1, 0))


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


def checks(_: Path) -> dict[str, Callable[[Shards], None]]:
    """What each rank goes through, in this order."""
    plain = (
        check_drawing,
        check_that_nothing_stays,
        check_planning_ahead,
        check_that_plans_are_forgotten,
        check_looking_away,
        check_levelling,
        check_an_empty_shard,
        check_drift,
        check_pruning,
    )
    by_response = partial(check_pruning, redistribution="none", score="response-contribution", selection="top")
    return {
        **{check.__name__: check for check in plain},
        "check_pruningresponse-contribution": by_response,
        **{check.__name__: check for check in (check_refusal, check_averages)},
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_ranks: RunRanks) -> Path:
    """Where two ranks have gone through all checks, once for all tests."""
    folder = tmp_path_factory.mktemp("ranks")
    run_ranks(__file__, folder)
    return folder


@pytest.mark.parametrize("name", checks(Path()))
def test_two_ranks(folder: Path, name: str, passed: Passed) -> None:
    passed(folder, name)
