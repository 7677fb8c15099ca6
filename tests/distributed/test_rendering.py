"""Two processes over gloo render, and plan the exchange of, one field as one process does.

``rank.py`` runs the checks of this file on each rank; the tests read their results.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from shared_fields import (
    COLORS,
    NAMES,
    RANKS,
    Passed,
    RunRanks,
    Views,
    a_field,
    a_view,
    draw,
    loss_of,
    own_half,
    render,
    shard_of,
    source_of,
    still,
)
from torch import Tensor
from torch.nn import Parameter

from sundae_ns.distributed import Shards
from sundae_ns.distributed.shards import bounds
from sundae_ns.distributed.source import statistics_of
from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization.sharded import camera_row, cameras_of_rows, may_be_seen
from sundae_ns.rendering import StepResolution, TrainingView, View
from sundae_ns.training.densification import CappedStrategy


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


def checks(_: Path) -> dict[str, Callable[[Shards], None]]:
    """The checks of each rank, in this order."""
    every = (
        check_drawing,
        check_that_nothing_stays,
        check_planning_ahead,
        check_that_plans_are_forgotten,
        check_looking_away,
        check_batches,
    )
    return {check.__name__: check for check in every}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_ranks: RunRanks) -> Path:
    """Results of two ranks that ran all checks, once for all tests."""
    folder = tmp_path_factory.mktemp("ranks")
    run_ranks(__file__, folder)
    return folder


@pytest.mark.parametrize("name", checks(Path()))
def test_two_ranks(folder: Path, name: str, passed: Passed) -> None:
    passed(folder, name)
