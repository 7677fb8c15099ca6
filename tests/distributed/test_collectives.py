"""Two processes over gloo share one field: they render, plan, balance and prune as one process does.

``rank.py`` runs the checks of this file on each rank; the tests read their results.
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

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.distributed import ShardedField, Shards
from sundae_ns.distributed.batches import average_gradients
from sundae_ns.distributed.densification import ShardedDensification
from sundae_ns.distributed.pruning import RankPruner
from sundae_ns.distributed.shards import bounds
from sundae_ns.distributed.source import send_statistics, statistics_of
from sundae_ns.distributed.team import take_shard
from sundae_ns.errors import ConfigError
from sundae_ns.gaussians.field import Field
from sundae_ns.pruning.cutting import FieldPruner
from sundae_ns.rasterization import rasterize, select_backend
from sundae_ns.rasterization.sharded import Cameras, camera_row, cameras_of_rows, may_be_seen
from sundae_ns.rendering import ColorSettings, Primitives, StepResolution, TrainingView, View
from sundae_ns.rendering.source import colors_from
from sundae_ns.training.densification import CappedStrategy
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.schedules import PruningSchedule

RunRanks = Callable[[str, Path], None]
Passed = Callable[[Path, str], None]
RANKS = 2
REFERENCE = select_backend("reference", "cpu")
COLORS = ColorSettings(REFERENCE)
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


def draw(params: Any, view: View) -> Any:
    """Splat primitives: received ones by their colours, a whole field by those that it has from the view."""
    colors = params["colors"] if "colors" in params else colors_from(params, params, view.center, COLORS)
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


def shard_of(params: dict[str, Tensor], start: int, end: int) -> Field:
    return Field({name: Parameter(value[start:end].clone()) for name, value in params.items()})


def own_half(shards: Shards) -> Field:
    """The block of 45 primitives that this rank holds of a field of 90."""
    return shard_of(a_field(), *bounds(90, RANKS)[shards.rank : shards.rank + 2])


def source_of(shards: Shards, field: Field) -> ShardedField:
    """A sharded field whose plans are dropped when it changes, as :meth:`sundae_ns.distributed.Team.share` makes it."""
    views: Any = Views(shards.rank)
    source = ShardedField(shards, field, views)
    shards.changed = source.forget_plan
    return source


def render(source: ShardedField, view: View, *, at: StepResolution | None = None) -> tuple[Primitives, Any]:
    """The primitives that a view receives, and their image, with densification's statistics after the backward pass."""
    received = source.primitives(view, COLORS, features=True, at=at)
    splat = draw(received, view)
    splat.info["means2d"].retain_grad()
    splat.info["route"] = received.route
    send_statistics(splat.info, absgrad=True)
    return received, splat


def check_drawing(shards: Shards) -> None:
    """Images, gradients and statistics of two ranks are those of one process for both images."""
    start, end = ((0, 60), (60, 90))[shards.rank]
    params = shard_of(a_field(), start, end)
    source = source_of(shards, params)
    shards.recount(params)
    assert shards.counts == [60, 30]
    assert source.total == 90
    received, splat = render(source, a_view(shards.rank))
    assert 0 < len(received["means"]) <= 90
    loss_of(splat, shards.rank).backward()
    state = {"grad2d": None, "count": None, "radii": None}
    CappedStrategy(absgrad=True)._update_state(params, state, {"statistics": statistics_of(splat.info)})

    whole = shard_of(a_field(), 0, 90)
    one = [draw(whole, a_view(rank)) for rank in range(RANKS)]
    for splats in one:
        splats.info["means2d"].retain_grad()
    losses = [loss_of(splats, rank) for rank, splats in enumerate(one)]
    (sum(losses) / RANKS).backward()  # type: ignore[union-attr]

    for image in ("colors", "depth", "alpha"):
        worst = float((getattr(splat, image) - getattr(one[shards.rank], image)).abs().max())
        assert worst < 1e-14, f"{image} differs by {worst:.2g}"
    for name in NAMES:
        expected = whole[name].grad[start:end]
        assert expected.abs().max() > 0, name
        worst = float((params[name].grad - expected).abs().max() / expected.abs().max())
        assert worst < 1e-12, f"{name} differs by {worst:.2g} of the largest gradient"

    # The sums of gsplat's strategy over the two images, one at a time.
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
    """Nothing keeps the tensors of a step: Python's collector does not see cycles through autograd's graph."""
    params = own_half(shards)
    source = source_of(shards, params)
    shards.recount(params)
    received, splat = render(source, a_view(shards.rank))
    source.plan_next(StepResolution(1, 1, 0), still(params))  # the plan stays until that step
    loss_of(splat, shards.rank).backward()
    statistics_of(splat.info)
    route = weakref.ref(received.route)
    del received, splat
    gc.collect()
    assert route() is None
    assert source._planned is not None
    source.forget_plan()


def still(params: Field) -> dict[str, torch.optim.Optimizer]:
    """Optimizers that move nothing."""
    return {name: torch.optim.Adam([value], lr=0.0) for name, value in params.items()}


class Views:
    """A timetable in float64: two views, which the ranks take in turns, at the resolution of the step."""

    def __init__(self, rank: int) -> None:
        self.rank = rank

    def of(self, at: StepResolution, rank: int) -> View:
        view = a_view((at.step + rank) % RANKS).zoomed(1 / at.downscale)
        aside = torch.zeros(4, 4, dtype=torch.float64)
        aside[0, 3] = 1.2 * ((at.step + rank) % RANKS)  # so that each sees primitives that the other does not
        return view._replace(viewmat=view.viewmat + aside)

    def view(self, at: StepResolution) -> View:
        return self.of(at, self.rank)

    def cameras(self, at: StepResolution) -> Cameras:
        views = [self.of(at, rank) for rank in range(RANKS)]
        return cameras_of_rows(torch.stack([camera_row(v.viewmat, v.K, v.width, v.height, 0.01) for v in views]))


def check_planning_ahead(shards: Shards) -> None:
    """Steps whose exchange was planned ahead do what steps that plan at their start do, and what one process does."""
    start, end = bounds(90, RANKS)[shards.rank : shards.rank + 2]
    views = Views(shards.rank)
    small = {**a_field(), "scales": a_field()["scales"] - 2}
    steps = [StepResolution(step, 1, 0) for step in range(4)]

    def optimizers_of(params: Field) -> dict[str, torch.optim.Optimizer]:
        # At these rates the field moves far within three steps.
        return {name: torch.optim.Adam([value], lr=0.1, betas=(0.8, 0.9), eps=1e-8) for name, value in params.items()}

    found = {}
    for ahead in (True, False):
        params = shard_of(small, start, end)
        source = source_of(shards, params)
        shards.recount(params)
        optimizers, images, missed = optimizers_of(params), [], 0
        for at in steps[:-1]:
            assert (source._planned is not None) == (ahead and at.step > 0)
            view = views.view(at)
            received = source.primitives(view, COLORS, features=True, at=at)
            assert source._planned is None
            splat = draw(received, view)
            images.append(splat.colors.detach())
            if ahead:
                source.plan_next(steps[at.step + 1], optimizers)
                frusta = views.cameras(steps[at.step + 1]).bounds
                before = may_be_seen(params["means"], params["scales"], frusta)
            loss_of(splat, view.width).backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            if ahead:
                missed += int((may_be_seen(params["means"], params["scales"], frusta) & ~before).sum())
        # Without slack for the steps, the plan would leave primitives out.
        every = [count for (count,) in shards.numbers(missed)]
        assert not ahead or sum(every) > 0, every
        found[ahead] = images, {name: value.detach() for name, value in params.items()}

    whole = shard_of(small, 0, 90)
    optimizers = optimizers_of(whole)
    alone = []
    for at in steps[:-1]:
        drawn = [draw(whole, views.of(at, rank)) for rank in range(RANKS)]
        alone.append(drawn[shards.rank].colors.detach())
        losses = [loss_of(splat, views.of(at, rank).width) for rank, splat in enumerate(drawn)]
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
    """A changed field, or images of another size, get a new plan on all ranks; a silent change is an error."""
    params, views = own_half(shards), Views(shards.rank)
    source = source_of(shards, params)
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}

    def planned() -> bool:
        return source._planned is not None

    def plan() -> None:
        source.plan_next(StepResolution(1, 1, 0), still(params))
        assert planned()

    shards.recount(params)
    plan()
    # Images of another size, and another step.
    for at in (StepResolution(1, 2, 0), StepResolution(2, 1, 0)):
        plan()
        cameras, route = source._exchange(views.view(at), at)
        assert not planned()
        expected = views.cameras(at)
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
            source._exchange(views.view(StepResolution(1, 1, 0)), StepResolution(1, 1, 0))
    # Without a bound on the step nothing is planned.
    shards.recount(params)
    source.plan_next(StepResolution(1, 1, 0), {name: torch.optim.SGD([value]) for name, value in params.items()})
    assert not planned()


def check_looking_away(shards: Shards) -> None:
    """A rank that sees nothing takes part in the backward pass, and the other rank learns."""
    params = own_half(shards)
    source = source_of(shards, params)
    view = a_view(0)
    if shards.rank == 1:
        view = view._replace(viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]).double()) @ view.viewmat)
    received = source.primitives(view, COLORS, features=True)
    assert (len(received["means"]) == 0) == (shards.rank == 1)
    loss_of(draw(received, view), 0).backward()
    whole = shard_of(a_field(), 0, 90)
    (loss_of(draw(whole, a_view(0)), 0) / RANKS).backward()
    start, end = bounds(90, RANKS)[shards.rank : shards.rank + 2]
    for name in NAMES:
        torch.testing.assert_close(params[name].grad, whole[name].grad[start:end], rtol=1e-10, atol=1e-14)


def check_an_empty_shard(shards: Shards) -> None:
    """Fewer primitives than ranks: a rank without any renders those of the other, and takes a step."""
    params = own_half(shards)
    optimizers = adams(params, 0)
    every = torch.zeros(90, dtype=torch.bool)
    seen = int(draw(Field(a_field()), a_view(0)).radii.argmax())
    every[seen] = True
    shards.level(params, optimizers, [], every[45 * shards.rank : 45 * shards.rank + 45])
    assert shards.counts == [0, 1]
    splat = draw(source_of(shards, params).primitives(a_view(0), COLORS, features=True), a_view(0))
    alone = shard_of(a_field(), seen, seen + 1)
    expected = draw(alone, a_view(0))
    torch.testing.assert_close(splat.colors, expected.colors)
    loss_of(splat, 0).backward()
    loss_of(expected, 0).backward()
    for name, value in params.items():
        if shards.rank == 1:  # both ranks have the same image, so the mean is that of one
            torch.testing.assert_close(value.grad, alone[name].grad, rtol=1e-10, atol=1e-14)
        optimizers[name].step()
        assert len(value) == shards.counts[shards.rank]


class Tripling:
    """A strategy that grows the shard of rank 1 only, and raises its peak."""

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
    """Shards that have drifted apart are balanced after densification, in order; the peak is that of all ranks."""
    start, end = ((0, 60), (60, 90))[shards.rank]
    params = shard_of(a_field(), start, end)
    source = source_of(shards, params)
    shards.recount(params)
    optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}
    _, splat = render(source, a_view(shards.rank))
    loss_of(splat, shards.rank).backward()
    state = FieldState(
        field=params,
        networks=torch.nn.ModuleDict(),
        optimizers=optimizers,
        densification={"count": torch.arange(start, end), "peak": 100},
        info=splat.info,
        step=19,
        densify_until=100,
    )
    strategy: Any = Tripling()
    densification, run = ShardedDensification(strategy, shards), SimpleNamespace(state=state)
    planned: Any = object()
    source._planned, strategy.grows = planned, False
    densification.after_step(run)  # type: ignore[arg-type]
    assert source._planned is planned
    state.step, strategy.grows = 20, True
    densification.after_step(run)  # type: ignore[arg-type]
    assert source._planned is None
    assert shards.counts == [75, 75]
    assert state.densification["peak"] == 60 + 90 + 5
    every = torch.cat([torch.arange(60), torch.arange(60, 90).repeat_interleave(3)])
    own = every[75 * shards.rank : 75 * shards.rank + 75]
    assert torch.equal(state.densification["count"], own)
    assert torch.equal(params["means"], a_field()["means"][own])


def adams(params: Field, start: int) -> dict[str, torch.optim.Optimizer]:
    """Optimizers whose moments say to which row they belong."""
    made: dict[str, torch.optim.Optimizer] = {}
    for name, value in params.items():
        optimizer = torch.optim.Adam([value], lr=0.1)
        rows = torch.arange(start, start + len(value), dtype=value.dtype).reshape(-1, *[1] * (value.ndim - 1))
        moments = {"exp_avg": rows.expand_as(value).clone(), "exp_avg_sq": (rows + 0.5).expand_as(value).clone()}
        optimizer.state[value] = {"step": torch.tensor(7.0), **moments}
        made[name] = optimizer
    return made


def check_levelling(shards: Shards) -> None:
    """Rows move with their moments and counts, in order, also if one rank keeps none of its own."""
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
    whole["opacities"][[20, 170]], whole["scales"][160, 0] = torch.inf, -torch.inf  # opaque and flat ones stay
    weights = torch.rand(200, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    start, end = ((0, 120), (120, 200))[shards.rank]
    params = shard_of(whole, start, end)
    optimizers, counts = adams(params, start), {"grad2d": torch.arange(start, end)}
    shards.recount(params)
    schedule = PruningSchedule(config)
    state = schedule.initialize_state()
    asked = []

    def contribute(count: int | None) -> Tensor:  # of the finite primitives, which are balanced by then
        asked.append(count)
        return weights[counts["grad2d"]]

    report = schedule.after_step(RankPruner(params, optimizers, [counts], shards=shards), state, 2, contribute)
    assert asked == [round(0.3 * 199) if config.uses_detail else None] * config.uses_contribution

    alone = shard_of(whole, 0, 200)
    own_optimizers, own_counts = adams(alone, 0), {"grad2d": torch.arange(200)}
    own_state = schedule.initialize_state()
    pruner = FieldPruner(alone, own_optimizers, [own_counts])
    expected = schedule.after_step(pruner, own_state, 2, lambda _: weights[own_counts["grad2d"]])
    assert report is not None
    assert expected is not None
    assert (report.before, report.after, report.dropped_nonfinite) == (200, round(0.3 * 199), 1)
    assert report.step == 2
    assert (report.tau, report.sigma, report.peak) == (expected.tau, expected.sigma, expected.peak)
    assert state == own_state
    assert all(bool(value.isfinite().all()) for value in params.values())
    assert sum(shards.counts) == report.after
    here = slice(sum(shards.counts[: shards.rank]), sum(shards.counts[: shards.rank + 1]))
    assert torch.equal(counts["grad2d"], own_counts["grad2d"][here])
    for name, value in params.items():
        assert torch.equal(value, alone[name][here]), name
        for kind in ("exp_avg", "exp_avg_sq"):
            theirs = own_optimizers[name].state[alone[name]][kind][here]
            assert torch.equal(optimizers[name].state[value][kind], theirs), (name, kind)


def check_mending(shards: Shards) -> None:
    """Opaque primitives of one rank become finite, and NaN goes, before primitives move between ranks."""
    params = own_half(shards)
    shards.recount(params)
    if shards.rank == 1:
        with torch.no_grad():
            params["opacities"][:5], params["means"][7] = torch.inf, torch.nan
    assert RankPruner(params, {}, shards=shards).drop_nonfinite() == 1
    assert shards.total == 89
    assert all(bool(value.isfinite().all()) for value in params.values())


def check_refusal(shards: Shards) -> None:
    """All ranks raise the error that rank 0 finds."""
    params = own_half(shards)
    shards.recount(params)
    schedule = PruningSchedule(PruningConfig(prune_at=1, keep_ratio=0.3))
    with pytest.raises(ConfigError, match="pass over the training views"):
        schedule.after_step(RankPruner(params, {}, shards=shards), schedule.initialize_state(), 2)


def check_averages(shards: Shards) -> None:
    values = [torch.zeros(3, requires_grad=True), torch.zeros(2, 2, requires_grad=True), torch.zeros(1)]
    for value in values[:2]:
        value.grad = torch.full_like(value, float(shards.rank + 1))
    average_gradients(values)
    assert all((value.grad == 1.5).all() for value in values[:2])  # type: ignore[union-attr]
    assert shards.announce({"rank": shards.rank}) == {"rank": 0}
    assert shards.apart(values) == 0
    with torch.no_grad():
        values[1][1, 0] -= 0.25 * shards.rank
    assert shards.apart(values) == 0.25
    assert shards.apart([]) == 0
    assert shards.widest(None) is None
    assert shards.widest(None if shards.rank == 0 else (3.0, 4.0)) == (3.0, 4.0)
    assert shards.widest((2.0 + shards.rank, 5.0 + shards.rank)) == (2.0, 6.0)


def check_batches(shards: Shards) -> None:
    """Values of a batch are added where the primitives are held; a view that is repeated is not counted."""
    params = own_half(shards)
    source = source_of(shards, params)
    shards.recount(params)
    views = [TrainingView(a_view(index % 2), None) for index in range(3)]
    batches = source.batches(views)
    assert [batch.num_views for batch in batches] == [2, 1]
    assert [batch.own for batch in batches] == [views[shards.rank], views[2]]
    seen = [may_be_seen(params["means"], params["scales"], _frustum(a_view(rank))) for rank in range(RANKS)]
    total = torch.zeros(45)
    received = source.primitives(a_view(shards.rank), COLORS, features=False)
    source.accumulate(total, torch.full((len(received["means"]),), 10.0**shards.rank), received, batches[0])
    assert torch.equal(total, seen[0][0] * 1.0 + seen[1][0] * 10.0)
    total.zero_()
    source.accumulate(total, torch.full((len(received["means"]),), 10.0**shards.rank), received, batches[1])
    assert torch.equal(total, seen[0][0] * 1.0)


def _frustum(view: View) -> Tensor:
    return cameras_of_rows(camera_row(view.viewmat, view.K, view.width, view.height, 0.01)[None]).bounds


def check_taking_a_shard(shards: Shards) -> None:
    """All ranks get the field and the head of rank 0, and keep their block."""
    torch.manual_seed(shards.rank)
    field = Field({name: Parameter(value + shards.rank) for name, value in a_field().items()})
    networks = torch.nn.ModuleDict({"head": CompensationHead(HeadConfig(size="tiny", num_features=5))})
    state = FieldState(field=field, networks=networks)
    take_shard(state, shards)
    assert shards.counts == [45, 45]
    for name, value in own_half(shards).items():
        assert torch.equal(state.field[name], value), name
        assert state.field[name].untyped_storage().nbytes() == value.untyped_storage().nbytes()
    assert shards.apart(networks.parameters()) == 0


def checks(_: Path) -> dict[str, Callable[[Shards], None]]:
    """The checks of each rank, in this order."""
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
        **{
            check.__name__: check
            for check in (check_mending, check_refusal, check_averages, check_batches, check_taking_a_shard)
        },
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_ranks: RunRanks) -> Path:
    """Results of two ranks that ran all checks, once for all tests."""
    folder = tmp_path_factory.mktemp("ranks")
    run_ranks(__file__, folder)
    return folder


@pytest.mark.parametrize("name", checks(Path()))
def test_two_ranks(folder: Path, name: str, passed: Passed) -> None:
    passed(folder, name)
