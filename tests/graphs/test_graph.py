"""Edge weights and bandwidth rules, and their invariances."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.graphs import NeighborGraph, build_graph
from sundae_ns.graphs import graph as graph_module
from sundae_ns.graphs.graph import bandwidth, kth_smallest


def cloud(n: int = 120, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def dense(graph: NeighborGraph) -> torch.Tensor:
    W = torch.zeros(graph.N, graph.N, dtype=graph.weights.dtype)
    return W.scatter_add(1, graph.indices, graph.weights)


def edges(graph: NeighborGraph) -> int:
    return int((graph.weights > 0).sum())


def test_weights_follow_the_equation_of_the_paper() -> None:
    points = cloud(40)
    graph = build_graph(points, num_neighbors=39, tau=1.5, sigma=0.6)
    squared = (points[:, None] - points[None]).square().sum(-1)
    expected = torch.where(squared < 1.5, torch.exp(-squared / (2 * 0.6**2)), 0.0).fill_diagonal_(0)
    torch.testing.assert_close(dense(graph), expected)
    torch.testing.assert_close(graph.dw, expected.sum(1))
    assert edges(graph) == int((expected > 0).sum())
    assert (graph.tau, graph.sigma) == (1.5, 0.6)


def test_robust_rule_ignores_clones_and_floaters() -> None:
    points = cloud()
    clean = build_graph(points)
    spoiled = build_graph(torch.cat([points, points[:20], torch.full((5, 3), 1e9, dtype=torch.float64)]))
    assert clean.tau == pytest.approx((3 * clean.sigma) ** 2)
    assert spoiled.sigma == pytest.approx(clean.sigma, rel=0.25)
    assert not clean.isolated.all()
    assert edges(spoiled) > edges(clean)


def test_robust_rule_isolates_only_distant_points() -> None:
    graph = build_graph(torch.cat([cloud(200), torch.full((1, 3), 50.0, dtype=torch.float64)]))
    assert graph.isolated[-1]
    assert graph.isolated.sum() < 10


def test_literal_rule_is_the_papers_and_gives_an_empty_graph_on_clones() -> None:
    points = cloud()
    distances = torch.tensor([[0.1, 0.3], [0.2, 0.4]], dtype=torch.float64)
    tau, sigma = bandwidth(distances, "literal")
    assert tau == pytest.approx(10 * 0.1)
    assert sigma == pytest.approx(np.var([0.1, 0.3, 0.2, 0.4]))
    assert build_graph(points, rule="literal").weights.any()
    empty = build_graph(torch.cat([points, points[:1]]), rule="literal")
    assert empty.tau == 0
    assert not empty.weights.any()
    assert empty.isolated.all()


def test_overrides_replace_the_rule() -> None:
    distances = torch.rand(10, 4)
    assert bandwidth(distances, "robust", sigma=2.0) == (36.0, 2.0)
    assert bandwidth(distances, "robust", sigma=1e200) == (math.inf, 1e200)
    assert bandwidth(distances, "robust", tau=0.5).tau == 0.5
    assert bandwidth(distances, "literal", tau=0.5, sigma=0.25) == (0.5, 0.25)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sampled", [2**16, 256, 1], ids=["all in order", "near a sample", "near a sample of one"])
def test_kth_smallest_matches_sorting(dtype: torch.dtype, sampled: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graph_module, "SAMPLED", sampled)
    values = torch.cat([cloud(300).abs().flatten(), torch.zeros(40), torch.tensor([1e-40, 1e-30, 1e30, torch.inf])])
    values = values[torch.randperm(len(values))].to(dtype)
    ordered = values.sort().values.tolist()
    for k in (0, 30, 40, 41, 42, 500, len(values) - 2, len(values) - 1):
        assert kth_smallest(values, k) == ordered[k]


def test_a_misleading_sample_does_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """All sampled values are 1 and no other value is."""
    monkeypatch.setattr(graph_module, "SAMPLED", 64)
    values = torch.arange(10_000.0)
    values[torch.randint(10_000, (64,), generator=torch.Generator().manual_seed(0))] = 1.0
    ordered = values.sort().values.tolist()
    for k in (0, 5000, 9999):
        assert kth_smallest(values, k) == ordered[k]


@pytest.mark.parametrize("options", [{"tau": -1.0}, {"tau": math.nan}, {"sigma": 0.0}, {"rule": "other"}])
def test_bad_bandwidth_is_refused(options: dict) -> None:
    with pytest.raises(ConfigError):
        build_graph(cloud(20), num_neighbors=4, **options)


@pytest.mark.parametrize("rule", ["robust", "literal"])
def test_coincident_points_are_neighbours_or_isolated_but_never_nan(rule: str) -> None:
    graph = build_graph(torch.zeros(30, 3), num_neighbors=4, rule=rule)
    assert graph.weights.isfinite().all()
    assert edges(graph) == (120 if rule == "robust" else 0)


def test_permutation_equivariance() -> None:
    points = cloud()
    order = torch.randperm(120, generator=torch.Generator().manual_seed(3))
    graph, shuffled = build_graph(points), build_graph(points[order])
    torch.testing.assert_close(dense(shuffled), dense(graph)[order][:, order])
    assert shuffled.sigma == pytest.approx(graph.sigma, rel=1e-12)


def test_rigid_motion_and_scale() -> None:
    points = cloud()
    rotation = torch.linalg.qr(cloud(3, seed=5)).Q
    graph = build_graph(points)
    moved = build_graph(points @ rotation.T + 7.0)
    scaled = build_graph(points * 1e-6)
    torch.testing.assert_close(dense(moved), dense(graph))
    torch.testing.assert_close(dense(scaled), dense(graph))
    assert scaled.sigma == pytest.approx(1e-6 * graph.sigma)
    assert scaled.tau == pytest.approx(1e-12 * graph.tau)


def test_smallest_graphs() -> None:
    two = build_graph(torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]), num_neighbors=1)
    assert two.sigma == 1.0
    torch.testing.assert_close(two.weights, torch.full((2, 1), math.exp(-0.5)))
    with pytest.raises(DataError, match="1 primitives cannot have 1 neighbours"):
        build_graph(torch.zeros(1, 3), num_neighbors=1)
