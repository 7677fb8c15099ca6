"""Two processes over gloo balance and prune one field as one process does.

``rank.py`` runs the checks of this file on each rank; the tests read their results.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torch.distributed as dist
from photographed import COUNT, batch_of, begin, image_of, update
from shared_fields import (
    COLORS,
    Passed,
    RunRanks,
    a_field,
    a_view,
    adams,
    draw,
    loss_of,
    own_half,
    render,
    shard_of,
    source_of,
)
from torch import Tensor
from torch.nn import Parameter

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.distributed import Shards
from sundae_ns.distributed.batches import average_gradients
from sundae_ns.distributed.densification import ShardedDensification
from sundae_ns.distributed.pruning import RankPruner
from sundae_ns.distributed.team import _put_block, take_shard
from sundae_ns.errors import ConfigError
from sundae_ns.gaussians.field import Field
from sundae_ns.pruning.cutting import FieldPruner
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.schedules import PruningSchedule


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


def check_gains_of_photos(shards: Shards) -> None:
    """All ranks divide photos by the same gains, from what both have measured."""
    gains, run = begin()
    gains.total = shards.summed
    for index in range(shards.rank, COUNT, 2):
        gains.observe(image_of(index), image_of(index) * (1.3 if index % 3 else 1.0), None, batch_of(index))
    update(gains, run)
    state = gains.state_dict()
    assert state["counts"].tolist() == [1] * COUNT
    expected = torch.tensor([1.3 if index % 3 else 1.0 for index in range(COUNT)]).log()
    torch.testing.assert_close(state["measured"].mean(dim=1).float(), expected, rtol=1e-4, atol=1e-4)
    assert state["gains"].std() > 0.05


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


def check_drop(shards: Shards) -> None:
    """Rows of one rank go, unless they are too many of the whole field."""
    params = own_half(shards)
    shards.recount(params)
    mask = torch.zeros(len(params["means"]), dtype=torch.bool)
    mask[:9] = shards.rank == 1
    pruner = RankPruner(params, {}, shards=shards)
    assert pruner.drop(mask, at_most=0.05) == 0
    assert shards.total == 90
    assert pruner.drop(mask, at_most=0.1) == 9
    assert shards.total == 81
    assert abs(shards.counts[0] - shards.counts[1]) <= 1


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


def check_beginning_anew(shards: Shards) -> None:
    """The first rank's points are everyone's, and all begin with their block of its field."""
    assert shards.by_first(lambda: torch.full((2,), 3.0 + shards.rank)).tolist() == [3, 3]
    field = Field({name: Parameter(value[:10].clone()) for name, value in a_field().items()})
    state = FieldState(field=field, networks=torch.nn.ModuleDict())
    state.optimizers = adams(field, 0)
    _put_block(state, {name: value + shards.rank for name, value in a_field().items()}, shards=shards)
    assert shards.counts == [45, 45]
    for name, value in own_half(shards).items():
        assert torch.equal(state.field[name], value), name
        assert state.optimizers[name].param_groups[0]["params"][0] is state.field[name]


def checks(_: Path) -> dict[str, Callable[[Shards], None]]:
    """The checks of each rank, in this order."""
    plain = (
        check_levelling,
        check_gains_of_photos,
        check_an_empty_shard,
        check_drift,
        check_pruning,
    )
    rest = (check_mending, check_drop, check_refusal, check_averages, check_taking_a_shard, check_beginning_anew)
    by_response = partial(check_pruning, redistribution="none", score="response-contribution", selection="top")
    return {
        **{check.__name__: check for check in plain},
        "check_pruningresponse-contribution": by_response,
        **{check.__name__: check for check in rest},
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
