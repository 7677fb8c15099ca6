"""Merges of pairs: exact counts, likeness and weight decide, and no tie or island stops them."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sundae_ns.gaussians import from_points
from sundae_ns.gaussians.field import Field
from sundae_ns.graphs import NeighborGraph
from sundae_ns.pruning import PruneRule, field_graph, pairing, prune_field
from sundae_ns.pruning.pairing import pair_labels

PAIRS = PruneRule(selection="pairs")


def points(n: int = 400, seed: int = 0) -> Field:
    generator = torch.Generator().manual_seed(seed)
    places, colors = torch.rand(n, 3, generator=generator), torch.rand(n, 3, generator=generator)
    return Field(from_points(places, colors, sh_degree=1, num_features=0))


def graph_of(field: Field) -> NeighborGraph:
    return field_graph(field, PAIRS)


def row(*places: float, colors: Tensor | None = None) -> Field:
    """Primitives of width 0.5 along the x axis, grey unless colours are given."""
    n = len(places)
    means = torch.zeros(n, 3)
    means[:, 0] = torch.tensor(places)
    field = Field(
        from_points(means, torch.full((n, 3), 0.5) if colors is None else colors, sh_degree=0, num_features=0)
    )
    field["scales"] = torch.full((n, 3), 0.5).log()
    return field


@pytest.mark.parametrize("count", [1, 7, 40, 200, 399])
def test_a_prune_by_pairs_keeps_the_exact_count(count: int) -> None:
    field, weight = points(), torch.arange(400.0)
    pruned = prune_field(field, PAIRS, count, weight)
    assert pruned.field.num_primitives == int(pruned.decision.mask.sum()) == pruned.decision.kept == count
    again = prune_field(field, PAIRS, count, weight)
    assert all(torch.equal(value, again.field[name]) for name, value in pruned.field.items())


def test_labels_name_a_member_and_the_unseen_are_dropped() -> None:
    field, weight = points(), torch.arange(400.0)
    labels = pair_labels(field, graph_of(field), weight, 40)
    assert (labels[:12] == -1).all()  # together less than a thousandth of all weight
    merged = labels >= 0
    assert (labels[labels[merged]] == labels[merged]).all()


def test_the_most_alike_pair_merges_first() -> None:
    near = row(0.0, 1.0, 1.1, 2.1)
    assert pair_labels(near, graph_of(near), torch.ones(4), 3).tolist() in ([0, 1, 1, 3], [0, 2, 2, 3])
    colors = torch.tensor([[0.9] * 3, [0.1] * 3, [0.1] * 3, [0.9] * 3])
    even = row(0.0, 1.0, 2.0, 3.0, colors=colors)
    assert pair_labels(even, graph_of(even), torch.ones(4), 3).tolist() in ([0, 1, 1, 3], [0, 2, 2, 3])
    # Equal steps: the pair of least weight changes an image least.
    labels = pair_labels(even := row(0.0, 1.0, 2.0, 3.0), graph_of(even), torch.tensor([1.0, 2.0, 3.0, 4.0]), 3)
    assert labels.tolist() == [1, 1, 2, 3]


def test_equal_pairs_merge_many_at_once() -> None:
    """All pairs of a chain cost the same; in their own order only the first would be the cheapest of both ends."""
    field = row(*[0.0] * 256)
    first = torch.arange(255)
    groups = pairing._Groups(field, torch.ones(256), torch.device("cpu"))
    chosen = pairing._cheapest_of_both((first, first + 1), groups.cost(first, first + 1), 256)
    assert len(chosen) > 50


def test_clones_that_share_their_neighbours_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairing, "MOST_ROUNDS", 3)
    pruned = prune_field(row(*[0.0] * 256), PAIRS, 64, torch.ones(256))
    assert pruned.field.num_primitives == 64


def test_of_islands_the_heaviest_stay() -> None:
    field = row(*(1e6 * island + step for island in range(4) for step in range(20)))
    weight = torch.tensor([1.0, 4.0, 2.0, 3.0]).repeat_interleave(20)
    labels = pair_labels(field, graph_of(field), weight, 2)
    kept = labels[labels >= 0].unique()
    assert (kept // 20).tolist() == [1, 3]
    assert (labels[:20] == -1).all()
    assert (labels[20:40] >= 0).all()


@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_pairs_do_not_depend_on_the_scale_of_the_scene(factor: float) -> None:
    field, weight = points(), torch.rand(400, generator=torch.Generator().manual_seed(1))
    scaled = field.replaced({"means": field["means"] * factor, "scales": field["scales"] + math.log(factor)})
    masks = [prune_field(each, PAIRS, 40, weight).decision.mask for each in (field, scaled)]
    assert (masks[0] == masks[1]).float().mean() > 0.95


def test_a_primitive_that_overflows_stops_nothing() -> None:
    field = points()
    field["scales"][5] = 400.0
    assert prune_field(field, PAIRS, 40, torch.ones(400)).field.num_primitives == 40


def test_a_merge_by_pairs_loses_less_than_draws() -> None:
    """By the weighted variance of colours and places within the groups, which images show."""
    field = points(2000)
    graph, weight = graph_of(field), torch.ones(2000)
    values = torch.cat([field["means"], field["features_dc"]], dim=1).double()

    def spread(rule: PruneRule) -> float:
        pruned = prune_field(field, rule, 200, weight, graph)
        own = torch.cat([pruned.field["means"], pruned.field["features_dc"]], dim=1).double()
        return float(torch.cdist(values, own).min(dim=1).values.square().mean())

    assert spread(PAIRS) < 0.9 * spread(PruneRule())
