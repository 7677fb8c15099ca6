"""Groups of Gaussians that one replaces: Voronoi cells along the graph, and pairs; and the values after a merge."""

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from prunes import decide_share, draws
from prunes import gaussians as random_field
from scipy.sparse.csgraph import connected_components, dijkstra

from sundae_ns.core.gaussians import Gaussians, rgb_to_sh, sh_to_rgb
from sundae_ns.graph.graph import NeighborGraph, build_graph
from sundae_ns.pruning import merge
from sundae_ns.pruning.decision import prune_gaussians
from sundae_ns.pruning.merge import gaussian_graph, pair_labels, voronoi_labels
from sundae_ns.pruning.rule import PruneRule
from sundae_ns.scene.scene import from_points

PAIRS = PruneRule()
WEIGHTS = torch.linspace(0.1, 1, 300)


def gaussians(n=300):
    params = random_field(n, features=5)
    return {**params, "scales": params["scales"] * 0.3 - 2}


def test_labels_are_the_nearest_along_the_edges(monkeypatch):
    graph = build_graph(gaussians()["means"].double(), num_neighbors=3)
    mask = torch.rand(300, generator=torch.Generator().manual_seed(1)) < 0.05
    found = voronoi_labels(graph, mask)
    rows, lengths = np.repeat(np.arange(300), 3), -graph.weights.log().numpy().ravel()
    edge = graph.weights.numpy().ravel() > 0
    # Heirs follow edges from dropped Gaussians; the search from kept ones follows them backwards.
    backwards = sp.csr_matrix((lengths[edge], (graph.indices.numpy().ravel()[edge], rows[edge])), shape=(300, 300))
    kept = mask.nonzero().squeeze(1).numpy()
    distance, _, source = dijkstra(backwards, indices=kept, min_only=True, return_predecessors=True)
    expected = torch.from_numpy(source).long()
    reached = torch.from_numpy(np.isfinite(distance))
    assert not reached.all()
    assert len(expected[reached].unique()) > 5
    assert torch.equal(found[reached], expected[reached])
    monkeypatch.setattr(merge, "ROWS", 7)
    assert torch.equal(voronoi_labels(graph, mask), found)
    # The others follow edges in both directions; Gaussians in a component without a kept one have no label.
    _, component = connected_components(backwards, directed=False)
    joined = torch.from_numpy(np.isin(component, component[kept]))
    assert torch.equal(found >= 0, joined)
    assert int((joined & ~reached).sum()) > 0
    assert (component[found[joined]] == component[joined.numpy()]).all()


def test_against_edges_the_nearest_wins_and_then_the_lowest_index():
    # Node 0 has no neighbour; it is the neighbour of 1, 2 and 3, and as near to 2 as to 3.
    weights = torch.tensor([[0.0], [0.5], [0.9], [0.9]])
    graph = NeighborGraph(torch.tensor([[0], [0], [0], [0]]), weights, weights[:, 0], 1.0, 1.0)
    assert voronoi_labels(graph, torch.tensor([False, True, True, True])).tolist() == [2, 1, 2, 3]
    assert voronoi_labels(graph, torch.tensor([False, True, False, False])).tolist() == [1, 1, 1, 1]
    # A Gaussian without an edge has no label.
    alone = NeighborGraph(torch.tensor([[1], [0], [2]]), torch.tensor([[1.0], [1.0], [0.0]]), torch.ones(3), 1.0, 1.0)
    assert voronoi_labels(alone, torch.tensor([True, False, False])).tolist() == [0, 0, -1]


def test_chains_and_clones_have_one_label_over_many_hops_and_islands_have_none():
    line = torch.cartesian_prod(torch.arange(50.0), torch.zeros(1), torch.zeros(1))
    graph = build_graph(torch.cat([line, line[:4] + 1e6]), num_neighbors=2)
    assert voronoi_labels(graph, torch.arange(54) == 0).tolist() == [0] * 50 + [-1] * 4
    clones = build_graph(torch.zeros(100, 3), num_neighbors=4)
    assert all((voronoi_labels(clones, torch.arange(100) == stays) == stays).all() for stays in (0, 50, 99))


def test_appearance_keeps_labels_on_their_side_of_an_edge():
    params = gaussians(400)
    params["means"] = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
    params["scales"] = torch.full((400, 3), 0.5).log()
    left = params["means"][:, 0] < 9.5
    params["features_dc"] = rgb_to_sh(torch.where(left, 0.1, 0.9)[:, None].expand(-1, 3)).clone()
    # One kept Gaussian next to the edge on the left, and one far from it on the right.
    mask, wrong = torch.isin(torch.arange(400), torch.tensor([8 * 20 + 10, 19 * 20 + 10])), []
    for edges in ("centres", "appearance"):
        labels = voronoi_labels(gaussian_graph(params, draws(num_neighbors=8, edges=edges)), mask)
        wrong.append(int((left[labels] != left).sum()))
    assert wrong[0] > 40
    assert wrong[1] == 0
    params["features_dc"][:] = 0.1  # of one colour, which no difference divides
    assert gaussian_graph(params, draws(num_neighbors=8)).weights.isfinite().all()


@pytest.mark.parametrize("edges", ["centres", "appearance"])
def test_a_merge_keeps_the_weighted_sum_of_colours(edges):
    params = gaussians()
    config = draws(edges=edges)
    before = {name: value.clone() for name, value in params.items()}
    decision = decide_share(params, config, 0.1, WEIGHTS)
    assert all(torch.equal(params[name], before[name]) for name in params)
    assert {name: len(value) for name, value in decision.values.items()} == dict.fromkeys(params, 30)
    labels = voronoi_labels(gaussian_graph(params, config), decision.mask)
    total = torch.zeros(300).index_add_(0, labels.clamp_min(0), WEIGHTS * (labels >= 0))[decision.mask]
    found = (total[:, None] * decision.values["features_dc"]).sum(dim=0)
    torch.testing.assert_close(found, (WEIGHTS * (labels >= 0)) @ params["features_dc"], rtol=1e-4, atol=1e-4)
    plain = decide_share(params, draws(edges=edges, redistribution="none"), 0.1, WEIGHTS)
    assert torch.equal(plain.mask, decision.mask), "a merge does not change the selection"


@pytest.mark.parametrize("rule", [{}, {"score": "response", "edges": "centres"}])
def test_logits_are_pruned_as_their_colours(rule):
    """The selection is that of the same field in harmonics, and colours are averaged instead of logits."""
    logits = gaussians()
    logits["features_dc"] *= 4
    harmonics = {**logits, "features_dc": rgb_to_sh(logits["features_dc"].sigmoid())}
    fields = (Gaussians(logits, "logits"), Gaussians(harmonics))
    found, expected = (decide_share(each, draws(**rule), 0.3, WEIGHTS) for each in fields)
    assert torch.equal(found.mask, expected.mask)
    colors = sh_to_rgb(expected.values["features_dc"]).clamp(1e-3, 1 - 1e-3)
    same = found.values["features_dc"] == logits["features_dc"][found.mask]
    assert 0 < int(same.all(dim=1).sum()) < found.kept
    torch.testing.assert_close(found.values["features_dc"].sigmoid()[~same], colors[~same], rtol=0, atol=1e-6)
    for name in found.values.keys() - {"features_dc"}:
        assert torch.equal(found.values[name], expected.values[name])


@pytest.mark.gpu
def test_a_merge_on_the_gpu_gives_the_same_values():
    on_cpu = prune_gaussians(gaussians(), draws(), 30, WEIGHTS)
    on_gpu = prune_gaussians({n: value.cuda() for n, value in gaussians().items()}, draws(), 30, WEIGHTS.cuda())
    assert torch.equal(on_gpu.decision.mask.cpu(), on_cpu.decision.mask)
    for name, value in on_cpu.gaussians.items():
        assert on_gpu.gaussians[name].is_cuda
        torch.testing.assert_close(on_gpu.gaussians[name].cpu(), value, rtol=1e-4, atol=1e-5)


def points(n=400):
    places, colors = torch.rand(2, n, 3, generator=torch.Generator().manual_seed(0))
    return Gaussians(from_points(places, colors, sh_degree=1))


def graph_of(gaussians):
    return gaussian_graph(gaussians, PAIRS)


def row(*places, colors=None):
    """Gaussians of width 0.5 along the x axis, grey unless colours are given."""
    means = torch.tensor([[place, 0.0, 0.0] for place in places])
    colors = torch.full_like(means, 0.5) if colors is None else colors
    return Gaussians({**from_points(means, colors, sh_degree=0), "scales": torch.full_like(means, 0.5).log()})


def test_labels_name_a_member_and_the_unseen_are_dropped_in_few_rounds(monkeypatch):
    gaussians, weight = points(), torch.arange(400.0)
    monkeypatch.setattr(merge, "MOST_ROUNDS", 60)  # a round merges many pairs
    labels = pair_labels(gaussians, graph_of(gaussians), weight, 40)
    assert (labels == -1).tolist() == [True] * 13 + [False] * 387  # together less than a thousandth of all weight
    assert int((pair_labels(gaussians, graph_of(gaussians), weight.pow(9), 399) == -1).sum()) == 1, "no more than asked"
    merged = labels >= 0
    assert (labels[labels[merged]] == labels[merged]).all()


def test_the_most_alike_pair_merges_first():
    near = row(0.0, 1.0, 1.1, 2.1)
    assert pair_labels(near, graph_of(near), torch.ones(4), 3).tolist() in ([0, 1, 1, 3], [0, 2, 2, 3])
    even = row(0.0, 1.0, 2.0, 3.0, colors=torch.tensor([[0.9] * 3, [0.1] * 3, [0.1] * 3, [0.9] * 3]))
    assert pair_labels(even, graph_of(even), torch.ones(4), 3).tolist() in ([0, 1, 1, 3], [0, 2, 2, 3])
    # Equal steps: the pair of least weight changes an image least.
    labels = pair_labels(even := row(0.0, 1.0, 2.0, 3.0), graph_of(even), torch.tensor([1.0, 2.0, 3.0, 4.0]), 3)
    assert labels.tolist() == [1, 1, 2, 3]


def test_equal_pairs_merge_many_at_once_and_all_at_one_place_or_with_one_that_overflows_end(monkeypatch):
    """All pairs of a chain cost the same; in their own order only the first would be the cheapest of both ends."""
    gaussians = row(*[0.0] * 256)
    first = torch.arange(255)
    groups = merge._Groups(gaussians, torch.ones(256), torch.device("cpu"))
    assert len(merge._cheapest_of_both((first, first + 1), groups.cost(first, first + 1), 256)) > 50
    monkeypatch.setattr(merge, "MOST_ROUNDS", 3)
    assert prune_gaussians(gaussians, PAIRS, 64, torch.ones(256)).gaussians.num_gaussians == 64
    gaussians = points()
    gaussians["scales"][5] = 400.0  # it overflows
    assert prune_gaussians(gaussians, PAIRS, 40, torch.ones(400)).gaussians.num_gaussians == 40


def test_of_islands_the_heaviest_stay():
    gaussians = row(*(1e6 * island + step for island in range(4) for step in range(20)))
    labels = pair_labels(gaussians, graph_of(gaussians), torch.tensor([1.0, 4.0, 2.0, 3.0]).repeat_interleave(20), 2)
    assert (labels[labels >= 0].unique() // 20).tolist() == [1, 3]
    assert (labels[:20] == -1).all()
    assert (labels[20:40] >= 0).all()
