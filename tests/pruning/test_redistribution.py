"""Voronoi labels of dropped primitives, and values of kept primitives after a merge."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from prunes import decide_share
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from sundae_ns.errors import ConfigError
from sundae_ns.gaussians.field import Field
from sundae_ns.gaussians.parameters import rgb_to_sh, sh_to_rgb
from sundae_ns.graphs import NeighborGraph, build_graph
from sundae_ns.pruning import PruneRule, field_graph, redistribution
from sundae_ns.pruning.redistribution import voronoi_labels
from sundae_ns.training.schedulers import Decay, notify_pruned


def field(n: int = 300, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (3, 3)}
    shapes |= {"opacities": (1,), "features": (5,)}
    params = {name: torch.randn(n, *shape, generator=generator) for name, shape in shapes.items()}
    return {**params, "scales": params["scales"] * 0.3 - 2}


def weights(n: int = 300) -> Tensor:
    return torch.linspace(0.1, 1, n)


def test_labels_are_the_nearest_along_the_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = build_graph(field()["means"].double(), num_neighbors=3)
    mask = torch.rand(300, generator=torch.Generator().manual_seed(1)) < 0.05
    found = voronoi_labels(graph, mask)
    rows, lengths = np.repeat(np.arange(300), 3), -graph.weights.log().numpy().ravel()
    edge = graph.weights.numpy().ravel() > 0
    # Heirs follow edges from dropped primitives; the search from kept ones follows them backwards.
    backwards = sp.csr_matrix((lengths[edge], (graph.indices.numpy().ravel()[edge], rows[edge])), shape=(300, 300))
    kept = mask.nonzero().squeeze(1).numpy()
    distance, _, source = dijkstra(backwards, indices=kept, min_only=True, return_predecessors=True)
    expected = torch.from_numpy(source).long()
    reached = torch.from_numpy(np.isfinite(distance))
    assert not reached.all()
    assert len(expected[reached].unique()) > 5
    assert torch.equal(found[reached], expected[reached])
    monkeypatch.setattr(redistribution, "ROWS", 7)
    assert torch.equal(voronoi_labels(graph, mask), found)
    # The others follow edges in both directions; primitives in a component without a kept one have no label.
    _, component = connected_components(backwards, directed=False)
    joined = torch.from_numpy(np.isin(component, component[kept]))
    assert torch.equal(found >= 0, joined)
    assert int((joined & ~reached).sum()) > 0
    assert (component[found[joined]] == component[joined.numpy()]).all()


def test_the_one_clone_that_is_kept_labels_all() -> None:
    graph = build_graph(torch.zeros(100, 3), num_neighbors=4)
    for stays in (0, 3, 50, 99):
        assert (voronoi_labels(graph, torch.arange(100) == stays) == stays).all()


def test_against_edges_the_nearest_wins_and_then_the_lowest_index() -> None:
    # Node 0 has no neighbour; it is the neighbour of 1, 2 and 3, and as near to 2 as to 3.
    weights = torch.tensor([[0.0], [0.5], [0.9], [0.9]])
    graph = NeighborGraph(torch.tensor([[0], [0], [0], [0]]), weights, weights[:, 0], 1.0, 1.0)
    assert voronoi_labels(graph, torch.tensor([False, True, True, True])).tolist() == [2, 1, 2, 3]
    assert voronoi_labels(graph, torch.tensor([False, True, False, False])).tolist() == [1, 1, 1, 1]


def test_a_chain_has_one_label_over_many_hops_and_islands_have_none() -> None:
    line = torch.cartesian_prod(torch.arange(50.0), torch.zeros(1), torch.zeros(1))
    graph = build_graph(torch.cat([line, line[:4] + 1e6]), num_neighbors=2)
    mask = torch.zeros(54, dtype=torch.bool)
    mask[0] = True
    found = voronoi_labels(graph, mask)
    assert (found[:50] == 0).all()
    assert (found[50:] == -1).all()


def test_appearance_keeps_labels_on_their_side_of_an_edge() -> None:
    params = field(400)
    params["means"] = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
    params["scales"] = torch.full((400, 3), 0.5).log()
    left = params["means"][:, 0] < 9.5
    params["features_dc"] = rgb_to_sh(torch.where(left, 0.1, 0.9)[:, None].expand(-1, 3)).clone()
    mask = torch.zeros(400, dtype=torch.bool)
    # One kept primitive next to the edge on the left, and one far from it on the right.
    mask[[8 * 20 + 10, 19 * 20 + 10]] = True
    wrong = []
    for edges in ("centres", "appearance"):
        labels = voronoi_labels(field_graph(params, PruneRule(num_neighbors=8, edges=edges)), mask)
        wrong.append(int((left[labels] != left).sum()))
    assert wrong[0] > 40
    assert wrong[1] == 0


@pytest.mark.parametrize("edges", ["centres", "appearance"])
def test_a_merge_keeps_the_weighted_sum_of_colours(edges: Any) -> None:
    params = field()
    config = PruneRule(score="contribution", redistribution="merge", edges=edges)
    before = {name: value.clone() for name, value in params.items()}
    decision = decide_share(params, config, 0.1, weights())
    assert all(torch.equal(params[name], before[name]) for name in params)
    assert decision.values is not None
    assert {name: len(value) for name, value in decision.values.items()} == dict.fromkeys(params, 30)
    labels = voronoi_labels(field_graph(params, config), decision.mask)
    total = torch.zeros(300).index_add_(0, labels.clamp_min(0), weights() * (labels >= 0))[decision.mask]
    found = (total[:, None] * decision.values["features_dc"]).sum(dim=0)
    expected = (weights() * (labels >= 0)) @ params["features_dc"]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    # A merge does not change the selection.
    assert torch.equal(decide_share(params, replace(config, redistribution="none"), 0.1, weights()).mask, decision.mask)


@pytest.mark.parametrize("device", ["cpu", "field"])
@pytest.mark.parametrize(
    "rule",
    [
        {},
        {"score": "response-contribution", "selection": "sampled"},
        {"score": "response-contribution", "signal": "attributes", "edges": "centres"},
    ],
)
def test_logits_are_pruned_as_their_colours(rule: dict[str, Any], device: Any) -> None:
    """The selection is that of the same field in harmonics, and colours are averaged instead of logits."""
    logits = field()
    logits["features_dc"] *= 4
    harmonics = {**logits, "features_dc": rgb_to_sh(logits["features_dc"].sigmoid())}
    config = PruneRule(graph_device=device, **rule)
    found, expected = (
        decide_share(Field(logits, "logits"), config, 0.3, weights()),
        decide_share(harmonics, config, 0.3, weights()),
    )
    assert torch.equal(found.mask, expected.mask)
    assert found.values is not None
    assert expected.values is not None
    colors = sh_to_rgb(expected.values["features_dc"]).clamp(1e-3, 1 - 1e-3)
    own = logits["features_dc"][found.mask]
    same = found.values["features_dc"] == own
    assert 0 < int(same.all(dim=1).sum()) < found.kept
    torch.testing.assert_close(found.values["features_dc"].sigmoid()[~same], colors[~same], rtol=0, atol=1e-6)
    for name in found.values.keys() - {"features_dc"}:
        assert torch.equal(found.values[name], expected.values[name])


def test_merged_values_follow_a_permutation_a_scale_and_a_shift() -> None:
    params = {name: value.double() for name, value in field().items()}
    config = PruneRule(score="contribution", selection="top")
    plain = decide_share(params, config, 0.1, weights()).values
    assert plain is not None
    order = torch.randperm(300)
    shuffled = decide_share({k: v[order] for k, v in params.items()}, config, 0.1, weights()[order])
    assert shuffled.values is not None
    back = torch.argsort(order[shuffled.mask])
    for name, value in plain.items():
        torch.testing.assert_close(shuffled.values[name][back], value, rtol=1e-9, atol=1e-9)
    moved = {**params, "means": 1024 * params["means"] + 4096, "scales": params["scales"] + math.log(1024)}
    found = decide_share(moved, config, 0.1, weights()).values
    assert found is not None
    torch.testing.assert_close(found["means"], 1024 * plain["means"] + 4096)
    torch.testing.assert_close(found["scales"], plain["scales"] + math.log(1024))
    torch.testing.assert_close(found["opacities"], plain["opacities"])


def test_hard_fields_stay_finite() -> None:
    cloud = torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    hard = {
        "one spot": torch.zeros(200, 3),
        "two clusters": torch.cat([cloud[:100], cloud[100:] + 1e6]),
        "collinear": cloud * torch.tensor([1.0, 0, 0]),
        "1e-25": cloud * 1e-25,
        "a floater": torch.cat([cloud[:-1], torch.tensor([[3e37, 0, 0]])]),
    }
    for means in hard.values():
        for edges in ("centres", "appearance"):
            config = PruneRule(score="contribution", edges=edges)
            values = decide_share({**field(200), "means": means}, config, 0.05, weights(200)).values
            assert values is not None
            assert all(value.isfinite().all() for value in values.values())


def test_a_merge_without_training_views_is_refused() -> None:
    with pytest.raises(ConfigError, match="training views.* set redistribution to none"):
        decide_share(field(), PruneRule(score="random", redistribution="merge"))


def test_held_learning_rates_wait_for_the_last_prune() -> None:
    def rate(hold: bool) -> Any:
        decay = Decay(0.01, 100, 1.0, hold, 0)
        return decay, torch.optim.lr_scheduler.LambdaLR(Adam([Parameter(torch.zeros(1))]), decay)

    (centres, one), (head, two) = rate(False), rate(True)
    notify_pruned({"means": one, "compensation": two}, 10, 20_000, last=False)
    assert (centres.pruned_at, head.pruned_at) == (10, None)
    notify_pruned({"means": one, "compensation": two}, 20, 20_000)
    assert (centres.pruned_at, head.pruned_at) == (10, 20)


@pytest.mark.gpu
def test_a_merge_on_the_gpu_gives_the_same_values() -> None:
    config = PruneRule(score="contribution")
    on_cpu = decide_share(field(), config, 0.1, weights())
    on_gpu = decide_share({name: value.cuda() for name, value in field().items()}, config, 0.1, weights().cuda())
    assert torch.equal(on_gpu.mask.cpu(), on_cpu.mask)
    assert on_cpu.values is not None
    assert on_gpu.values is not None
    for name, value in on_cpu.values.items():
        assert on_gpu.values[name].is_cuda
        torch.testing.assert_close(on_gpu.values[name].cpu(), value, rtol=1e-4, atol=1e-5)


def test_isolated_primitives_have_no_label() -> None:
    graph = NeighborGraph(torch.tensor([[1], [0], [2]]), torch.tensor([[1.0], [1.0], [0.0]]), torch.ones(3), 1.0, 1.0)
    assert voronoi_labels(graph, torch.tensor([True, False, False])).tolist() == [0, 0, -1]
