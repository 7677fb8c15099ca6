"""Filters against exact spectra, and their invariances."""

from __future__ import annotations

import pytest
import torch

from sundae_ns.errors import DataError
from sundae_ns.filters import haar, high_pass, low_pass, response_magnitude
from sundae_ns.graphs import NeighborGraph, build_graph


def cloud(n: int = 60, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_walk(graph: NeighborGraph) -> torch.Tensor:
    """Dense A = D^-1 W; an isolated node is its own neighbour."""
    W = torch.zeros(graph.N, graph.N, dtype=graph.weights.dtype).scatter_add(1, graph.indices, graph.weights)
    W += torch.diag(graph.isolated.to(W.dtype))
    return W / W.sum(1, keepdim=True)


@pytest.mark.parametrize("num_neighbors", [5, 59])
def test_filters_match_the_exact_spectrum(num_neighbors: int) -> None:
    points = cloud()
    graph = build_graph(points, num_neighbors=num_neighbors, tau=100.0, sigma=0.5)
    eigenvalues, V = torch.linalg.eig(random_walk(graph))
    assert eigenvalues.abs().max().item() == pytest.approx(1.0)
    x = points.to(V.dtype)
    high = V @ ((1 - eigenvalues)[:, None] * torch.linalg.solve(V, x))
    low = V @ ((1 + eigenvalues)[:, None] * torch.linalg.solve(V, x))
    assert high.imag.abs().max() < 1e-8
    torch.testing.assert_close(high_pass(graph, points), high.real, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(low_pass(graph, points), low.real, rtol=1e-8, atol=1e-8)


def test_high_and_low_pass_add_up_and_constants_vanish() -> None:
    graph = build_graph(cloud(), num_neighbors=6, sigma=10.0)
    x = cloud(seed=1)
    torch.testing.assert_close(high_pass(graph, x) + low_pass(graph, x), 2 * x)
    assert high_pass(graph, torch.full((60,), 3.7, dtype=torch.float64)).abs().max() == 0


def test_shapes_dtypes_and_chunks_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = build_graph(cloud().float(), num_neighbors=6, sigma=10.0)
    x = cloud(seed=1)
    whole = high_pass(graph, x)
    assert whole.dtype == torch.float64
    assert high_pass(graph, x.float()).dtype == torch.float32
    torch.testing.assert_close(high_pass(graph, x[:, 0]), whole[:, 0])
    monkeypatch.setattr(haar, "CHUNK_ELEMENTS", 7 * 18)
    assert torch.equal(high_pass(graph, x), whole)


def test_isolated_nodes_are_nan() -> None:
    points = torch.cat([cloud(), torch.full((1, 3), 1e3, dtype=torch.float64)])
    graph = build_graph(points, num_neighbors=6)
    alone = graph.isolated
    assert alone[-1]
    assert torch.equal(high_pass(graph, points).isnan().all(dim=1), alone)
    assert torch.equal(response_magnitude(high_pass(graph, points)).isnan(), alone)
    A = random_walk(graph)
    torch.testing.assert_close(high_pass(graph, points)[~alone], (points - A @ points)[~alone])
    torch.testing.assert_close(low_pass(graph, points)[~alone], (points + A @ points)[~alone])


def test_one_node_and_no_node() -> None:
    for n in (0, 1):
        graph = NeighborGraph(torch.zeros(n, 1, dtype=torch.int64), torch.zeros(n, 1), torch.zeros(n), 1.0, 1.0)
        assert high_pass(graph, torch.ones(n, 2)).shape == (n, 2)
        assert high_pass(graph, torch.ones(n)).isnan().all()
    bare = NeighborGraph(torch.zeros(1, 0, dtype=torch.int64), torch.zeros(1, 0), torch.zeros(1), 1.0, 1.0)
    assert high_pass(bare, torch.ones(1, 2)).isnan().all()


def test_two_nodes_respond_with_their_difference() -> None:
    points = torch.tensor([[0.0, 0, 0], [2.0, 0, 0]])
    graph = build_graph(points, num_neighbors=1)
    assert high_pass(graph, points).tolist() == [[-2.0, 0, 0], [2.0, 0, 0]]
    assert response_magnitude(high_pass(graph, points)).tolist() == [4.0, 4.0]


def test_invariances_of_the_position_response() -> None:
    points = cloud()
    rotation = torch.linalg.qr(cloud(3, seed=5)).Q
    order = torch.randperm(60, generator=torch.Generator().manual_seed(3))

    def magnitude(x: torch.Tensor) -> torch.Tensor:
        return response_magnitude(high_pass(build_graph(x, num_neighbors=8), x))

    base = magnitude(points)
    same = {"rtol": 1e-9, "atol": 1e-12, "equal_nan": True}
    torch.testing.assert_close(magnitude(points[order]), base[order], **same)
    torch.testing.assert_close(magnitude(points @ rotation.T + 3.0), base, **same)
    torch.testing.assert_close(magnitude(100 * points) / 100**2, base, **same)


def test_float32_far_from_the_origin_keeps_its_digits() -> None:
    # Coordinates are exact in float32 at this offset, so float64 has the same field.
    points = (cloud(300) * 64).round() / 64 + 1e5
    exact_graph = build_graph(points, num_neighbors=8, tau=4.0, sigma=0.5)
    exact = high_pass(exact_graph, points)
    known = ~exact_graph.isolated
    single = points.float()
    assert torch.equal(single.double(), points)
    graph = build_graph(single, num_neighbors=8, tau=4.0, sigma=0.5)
    assert torch.equal(graph.isolated, exact_graph.isolated)
    worst = (high_pass(graph, single) - exact)[known].abs().max().item()
    assert worst < 2e-6  # measured 1.5e-7
    naive = single - random_walk(graph) @ single
    assert (naive - exact)[known].abs().max().item() > 1e-3  # measured 2.2e-2, the reason for the difference form


def test_wrong_signal_is_refused() -> None:
    graph = build_graph(cloud(), num_neighbors=6)
    for shape in ((59, 3), (60, 3, 1), ()):
        with pytest.raises(DataError, match="60 nodes"):
            high_pass(graph, torch.zeros(shape))


def test_magnitudes_of_tiny_responses_do_not_vanish() -> None:
    response = torch.tensor([[1e-30, 0.0], [3e-30, 4e-30], [torch.nan, 0.0]])
    magnitude = response_magnitude(response)
    assert magnitude.dtype == torch.float64
    torch.testing.assert_close(magnitude[:2], torch.tensor([1e-60, 25e-60], dtype=torch.float64), rtol=1e-6, atol=0)
    assert magnitude[2].isnan()
    assert response_magnitude(torch.tensor([-3.0])).tolist() == [9.0]
    assert response_magnitude(torch.zeros(0, 3)).shape == (0,)
