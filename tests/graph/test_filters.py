"""Filters against dense algebra, and their invariances."""

import numpy as np
import pytest
import torch
from fields import normal_points as cloud

from sundae_ns.core.errors import DataError
from sundae_ns.graph import filters
from sundae_ns.graph.filters import Smoother, high_pass, response_magnitude
from sundae_ns.graph.graph import NeighborGraph, build_graph


def random_walk(graph):
    """Dense A = D^-1 W; an isolated node is its own neighbour."""
    W = torch.zeros(graph.N, graph.N, dtype=graph.weights.dtype).scatter_add(1, graph.indices, graph.weights)
    W += torch.diag(graph.isolated.to(W.dtype))
    return W / W.sum(1, keepdim=True)


@pytest.mark.parametrize("num_neighbors", [5, 60])
def test_filters_match_dense_algebra_and_isolated_nodes_are_nan(num_neighbors):
    points = torch.cat([cloud(), torch.full((1, 3), 1e3, dtype=torch.float64)])
    graph = build_graph(points, num_neighbors=num_neighbors)
    alone, A = graph.isolated, random_walk(graph)
    assert alone[-1]
    assert torch.linalg.eigvals(A).abs().max().item() == pytest.approx(1.0)
    assert torch.equal(response_magnitude(high_pass(graph, points)).isnan(), alone)
    torch.testing.assert_close(high_pass(graph, points)[~alone], (points - A @ points)[~alone])


def test_shapes_dtypes_and_chunks_agree_and_constants_vanish(monkeypatch):
    graph, x = build_graph(cloud().float(), num_neighbors=6), cloud(seed=1)
    whole = high_pass(graph, x)
    assert high_pass(graph, torch.full((60,), 3.7, dtype=torch.float64)).abs().max() == 0
    assert whole.dtype == torch.float64
    assert high_pass(graph, x.float()).dtype == torch.float32
    torch.testing.assert_close(high_pass(graph, x[:, 0]), whole[:, 0])
    monkeypatch.setattr(filters, "CHUNK_ELEMENTS", 7 * 18)
    assert torch.equal(high_pass(graph, x), whole)
    for shape in ((59, 3), (60, 3, 1), ()):
        with pytest.raises(DataError, match="60 nodes"):
            high_pass(graph, torch.zeros(shape))


def test_one_node_and_no_node():
    for n in (0, 1):
        graph = NeighborGraph(torch.zeros(n, 1, dtype=torch.int64), torch.zeros(n, 1), torch.zeros(n), 1.0, 1.0)
        assert high_pass(graph, torch.ones(n, 2)).shape == (n, 2)
        assert high_pass(graph, torch.ones(n)).isnan().all()
    bare = NeighborGraph(torch.zeros(1, 0, dtype=torch.int64), torch.zeros(1, 0), torch.zeros(1), 1.0, 1.0)
    assert high_pass(bare, torch.ones(1, 2)).isnan().all()


def test_float32_far_from_the_origin_keeps_its_digits():
    # Coordinates are exact in float32 at this offset, so float64 has the same field.
    points = (cloud(300) * 64).round() / 64 + 1e5
    exact_graph = build_graph(points, num_neighbors=8)
    exact = high_pass(exact_graph, points)
    known = ~exact_graph.isolated
    single = points.float()
    assert torch.equal(single.double(), points)
    graph = build_graph(single, num_neighbors=8)
    assert torch.equal(graph.isolated, exact_graph.isolated)
    assert (high_pass(graph, single) - exact)[known].abs().max().item() < 2e-6  # measured 9.1e-8
    naive = single - random_walk(graph) @ single
    assert (naive - exact)[known].abs().max().item() > 1e-3  # measured 2.2e-2, the reason for the difference form


def test_magnitudes_of_tiny_responses_do_not_vanish():
    magnitude = response_magnitude(torch.tensor([[1e-30, 0.0], [3e-30, 4e-30], [torch.nan, 0.0]]))
    assert magnitude.dtype == torch.float64
    torch.testing.assert_close(magnitude[:2], torch.tensor([1e-60, 25e-60], dtype=torch.float64), rtol=1e-6, atol=0)
    assert magnitude[2].isnan()
    assert response_magnitude(torch.tensor([-3.0])).tolist() == [9.0]
    assert response_magnitude(torch.zeros(0, 3)).shape == (0,)


@pytest.mark.parametrize("strength", [0.0, 0.3, 8.0, 100.0])
def test_it_solves_its_equation_for_the_known_nodes(strength):
    graph, signal = build_graph(cloud(), num_neighbors=6), cloud(seed=1).numpy()
    W = torch.zeros(graph.N, graph.N, dtype=torch.float64).scatter_add(1, graph.indices, graph.weights.double())
    W = 0.5 * (W + W.T)
    laplacian = (strength / W.sum(1).mean() * (torch.diag(W.sum(1)) - W)).numpy()
    smoother, known = Smoother(graph, strength), np.arange(60) % 3 > 0
    for mask in (np.ones(60, bool), known):  # one after the other: factors of other nodes must not be kept
        signal[~mask] = np.nan  # never read
        smooth = smoother(signal, mask)
        system = np.diag(np.maximum(mask, 1e-9)) + laplacian
        np.testing.assert_allclose(system @ smooth, np.where(mask[:, None], signal, 0.0), atol=1e-9)
        # What is left is a high-pass response: it changes no mean.
        np.testing.assert_allclose((signal - smooth)[mask].sum(axis=0), 0.0, atol=1e-4)


def test_a_constant_is_smooth_and_what_changes_from_node_to_node_is_not():
    angle = torch.linspace(0, 2 * torch.pi, 61)[:60]
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros(60)], dim=1)
    smoother, known = Smoother(build_graph(ring, num_neighbors=4), 8.0), np.ones(60, bool)
    slow, fast = np.sin(angle.numpy())[:, None], np.where(np.arange(60) % 2, 1.0, -1.0)[:, None]
    np.testing.assert_allclose(smoother(np.full((60, 2), 3.7), known), 3.7)
    assert np.abs(smoother(slow, known) - slow).max() < 0.1
    assert np.abs(smoother(fast, known)).max() < 0.1


def test_a_node_without_an_edge_keeps_its_value():
    graph = build_graph(torch.cat([cloud(), torch.tensor([[1e3, 0, 0], [0, 1e3, 0]])]), num_neighbors=6)
    assert graph.isolated.tolist()[-2:] == [True, True]
    smooth = Smoother(graph, 8.0)(np.full((62, 1), 2.0), np.arange(62) < 61)
    assert smooth[60] == pytest.approx(2.0)
    assert smooth[61] == 0
    graph, signal = build_graph(torch.zeros(5, 3), num_neighbors=2), cloud(5, seed=1).numpy()
    graph.weights.zero_()  # no edges at all
    np.testing.assert_allclose(Smoother(graph, 8.0)(signal, np.ones(5, bool)), signal)
