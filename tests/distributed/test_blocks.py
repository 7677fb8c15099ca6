"""The arithmetic of several ranks in one process: the rows of each rank, and its part of a checkpoint.

``test_rendering.py`` and ``test_shards.py`` run the collectives.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from sundae_ns.distributed import checkpoints
from sundae_ns.distributed.shards import bounds, moves
from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians.field import Field
from sundae_ns.gaussians.surgery import per_primitive
from sundae_ns.storage.runs.checkpoint import FORMAT
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.schedules import PruningSchedule

NAMES = ("means", "quats", "scales", "opacities", "features_dc", "features_rest", "features")
RANKS = 3


@given(st.integers(0, 200), st.integers(1, 9))
def test_blocks_are_as_even_as_they_can_be(total: int, ranks: int) -> None:
    ends = bounds(total, ranks)
    sizes = [end - start for start, end in pairwise(ends)]
    assert (len(sizes), ends[0], ends[-1]) == (ranks, 0, total)
    assert max(sizes) - min(sizes) <= 1


@given(st.lists(st.integers(0, 40), min_size=1, max_size=6))
def test_moved_rows_lie_in_even_blocks_in_the_same_order(counts: list[int]) -> None:
    ranks = len(counts)
    plans = [moves(counts, rank) for rank in range(ranks)]
    rows = iter(range(sum(counts)))
    held = [[next(rows) for _ in range(count)] for count in counts]
    arrived: list[list[int]] = [[] for _ in range(ranks)]
    for rank, (sent, _) in enumerate(plans):
        assert sum(sent) == counts[rank]
        for other, count in enumerate(sent):
            assert plans[other][1][rank] == count, "one sends rows that the other does not wait for"
            arrived[other] += [held[rank].pop(0) for _ in range(count)]
    assert [row for block in arrived for row in block] == list(range(sum(counts)))
    ends = bounds(sum(counts), ranks)
    assert [len(block) for block in arrived] == [end - start for start, end in pairwise(ends)]


def a_checkpoint(n: int = 10, step: int = 29) -> dict[str, Any]:
    """A checkpoint of a trainer on one GPU, whose numbers say to which row they belong."""

    def rows(*shape: int) -> Tensor:
        return torch.arange(float(n)).reshape(-1, *[1] * len(shape)).expand(n, *shape).clone()

    widths = {"means": (3,), "features_rest": (8, 3), "features": (5,)}
    field = {name: rows(*widths.get(name, (2,))) for name in NAMES}
    moments = {"step": torch.tensor(float(n)), "exp_avg": rows(3), "exp_avg_sq": rows(3) + 0.5}
    decay = {"max_steps": 3000, "warmup_steps": 60, "pruned_at": None, "lr_final": 1e-6}
    pruned = {**decay, "pruned_at": step - 3}
    return {
        "step": step,
        "pipeline": {
            **{f"_model.gauss_params.{name}": value for name, value in field.items()},
            # As many numbers as the field has rows, but not rows of it.
            "_model.networks.head.bias": torch.arange(float(n)),
            "_model._extra_state": {
                "step": step,
                "format": FORMAT,
                "running": {
                    "densification": {
                        "grad2d": rows(),
                        "scale": torch.tensor(2.0),
                        "peak": 12,
                        "other": torch.zeros(n + 1),
                    },
                    "pruning": {"pruned_at": -1, "num_prunes": 0},
                },
                "extensions": {"densification": {}, "pruning": {}},
            },
        },
        "optimizers": {
            "means": {"state": {0: moments}, "param_groups": [{"lr": 0.4, "initial_lr": 0.8, "betas": (0.9, 0.999)}]},
            "compensation": {"state": {0: {"exp_avg": torch.zeros(n)}}, "param_groups": [{"lr": 0.1}]},
        },
        "schedulers": {
            "means": {"last_epoch": step + 1, "base_lrs": [0.8], "_last_lr": [0.4], "lr_lambdas": [decay, pruned]}
        },
        "random": {"torch": torch.zeros(n)},
    }


def equal(a: Any, b: Any) -> bool:
    if isinstance(a, Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal, a, b))
    return a == (pytest.approx(b, rel=1e-12) if isinstance(b, float) else b)


def test_parts_of_a_checkpoint_are_rows_of_it_and_steps_of_larger_batches() -> None:
    whole = a_checkpoint()
    parts = [checkpoints.state_of_rank(whole, rank, RANKS, NAMES) for rank in range(RANKS)]
    for start, end, part in zip((0, 3, 6), (3, 6, 10), parts):
        for name in NAMES:
            assert torch.equal(
                part["pipeline"][f"_model.gauss_params.{name}"],
                whole["pipeline"][f"_model.gauss_params.{name}"][start:end],
            ), name
        assert torch.equal(
            part["pipeline"]["_model.networks.head.bias"], whole["pipeline"]["_model.networks.head.bias"]
        )
        extra = part["pipeline"]["_model._extra_state"]
        densification = extra["running"]["densification"]
        assert densification["grad2d"].tolist() == list(range(start, end))
        assert len(densification["other"]) == 11
        assert (densification["scale"], densification["peak"]) == (2, 12)
        assert extra["running"]["pruning"] == {"pruned_at": -1, "num_prunes": 0}
        assert (part["step"], extra["step"], extra["format"]) == (9, 9, FORMAT)
        assert extra["extensions"] == whole["pipeline"]["_model._extra_state"]["extensions"]
        moments = part["optimizers"]["means"]["state"][0]
        assert moments["step"] == 10
        assert moments["exp_avg"][:, 0].tolist() == list(range(start, end))
        assert len(part["optimizers"]["compensation"]["state"][0]["exp_avg"]) == 10
        (group,) = part["optimizers"]["means"]["param_groups"]
        assert group["lr"] == pytest.approx(0.4 * 3**0.5)
        assert group["initial_lr"] == pytest.approx(0.8 * 3**0.5)
        assert group["betas"] == (0.729, pytest.approx(0.999**3))
        schedule = part["schedulers"]["means"]
        assert schedule["last_epoch"] == 10
        assert schedule["base_lrs"] == pytest.approx([0.8 * 3**0.5])
        assert schedule["_last_lr"] == pytest.approx([0.4 * 3**0.5])
        assert schedule["lr_lambdas"] == [
            {"max_steps": 1000, "warmup_steps": 20, "pruned_at": None, "lr_final": 1e-6},
            {"max_steps": 1000, "warmup_steps": 20, "pruned_at": 8, "lr_final": 1e-6},
        ]
        assert len(part["random"]["torch"]) == 10
        # Not a view, which would keep the whole in memory.
        assert part["pipeline"]["_model.gauss_params.means"].untyped_storage().nbytes() == 4 * 3 * (end - start)


def test_the_parts_together_are_the_checkpoint() -> None:
    whole = a_checkpoint()
    whole["schedulers"]["means"]["lr_lambdas"].pop()  # a step within a batch becomes the last of it
    parts = [checkpoints.state_of_rank(whole, rank, RANKS, NAMES) for rank in range(RANKS)]
    held: list[list[Any]] = [[] for _ in parts]
    for part, values in zip(parts, held):
        checkpoints._map_state(part, NAMES, lambda value, values=values: values.append(value), Fraction(1, RANKS))
    sizes = [len(values[0]) for values in held]
    together = iter(torch.cat(values) if per_primitive(values[0], sizes[0]) else values[0] for values in zip(*held))
    again = checkpoints._map_state(parts[0], NAMES, lambda _: next(together), Fraction(1, RANKS))
    assert equal(again, whole)


def test_a_step_within_a_batch_becomes_the_last_whole_batch() -> None:
    """Images of an incomplete batch are seen again rather than left out."""
    for step, after in ((28, 8), (29, 9), (30, 9), (31, 9), (32, 10), (0, -1)):
        whole = a_checkpoint(step=step)
        part = checkpoints.state_of_rank(whole, 0, RANKS, NAMES)
        assert (part["step"], part["pipeline"]["_model._extra_state"]["step"]) == (after, after)


@pytest.mark.parametrize(
    ("ranks", "pruned_at"), [(2, 0), (4, 0), (4, 1), (8, 0), (8, 1), (8, 5), (2, 7), (3, -1), (1, 0)]
)
def test_a_prune_within_the_first_batch_is_not_repeated(ranks: int, pruned_at: int) -> None:
    whole = a_checkpoint()
    running = whole["pipeline"]["_model._extra_state"]["running"]
    running["pruning"] = {"pruned_at": pruned_at, "num_prunes": int(pruned_at >= 0)}
    whole["schedulers"]["means"]["lr_lambdas"][1]["pruned_at"] = max(pruned_at, 0)
    part = checkpoints.state_of_rank(whole, 0, ranks, NAMES)
    state = part["pipeline"]["_model._extra_state"]["running"]["pruning"]
    assert PruningSchedule(PruningConfig(prune_at=0)).due(state, 30, 10) == (pruned_at < 0)
    assert part["schedulers"]["means"]["lr_lambdas"][1]["pruned_at"] >= 0
    assert state["pruned_at"] <= pruned_at


def test_a_rank_may_get_no_primitive_of_a_checkpoint() -> None:
    parts = [checkpoints.state_of_rank(a_checkpoint(n=1), rank, 2, NAMES) for rank in range(2)]
    assert [len(part["pipeline"]["_model.gauss_params.means"]) for part in parts] == [0, 1]
    with pytest.raises(CheckpointError, match="the checkpoint holds no primitives; give another"):
        checkpoints.state_of_rank(a_checkpoint(n=0), 0, 2, NAMES)


def test_only_values_of_every_primitive_are_rows() -> None:
    assert per_primitive(torch.zeros(3, 2), 3)
    for other in (torch.tensor(3.0), torch.zeros(2, 3), [0, 0, 0], 3, None):
        assert not per_primitive(other, 3)


def a_field(n: int = 60) -> Field:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(n, *shape, generator=generator)

    return Field(
        {
            "means": normal(3),
            "quats": normal(4),
            "scales": normal(3) - 2,
            "opacities": normal(1),
            "features_dc": normal(3),
            "features_rest": normal(3, 3),
        }
    )


@pytest.mark.parametrize(("total", "ranks"), [(10, 3), (2, 4), (0, 2), (9, 1)])
def test_blocks_cover_all_rows_and_differ_by_one(total: int, ranks: int) -> None:
    ends = bounds(total, ranks)
    sizes = [b - a for a, b in zip(ends, ends[1:])]
    assert (ends[0], ends[-1]) == (0, total)
    assert max(sizes) - min(sizes) <= 1
