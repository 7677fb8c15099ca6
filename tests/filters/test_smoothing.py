"""The smooth part of signals on graphs, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sundae_ns.filters import Smoother
from sundae_ns.graphs import NeighborGraph, build_graph

Floats = NDArray[np.float64]


def cloud(n: int = 60, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def laplacian(graph: NeighborGraph, strength: float) -> Floats:
    W = torch.zeros(graph.N, graph.N, dtype=torch.float64).scatter_add(1, graph.indices, graph.weights.double())
    W = 0.5 * (W + W.T)
    return (strength / W.sum(1).mean() * (torch.diag(W.sum(1)) - W)).numpy()


@pytest.mark.parametrize("strength", [0.0, 0.3, 8.0, 100.0])
def test_it_solves_its_equation_for_the_known_nodes(strength: float) -> None:
    graph, signal = build_graph(cloud(), num_neighbors=6), cloud(seed=1).numpy()
    smoother, known = Smoother(graph, strength), np.arange(60) % 3 > 0
    for mask in (np.ones(60, bool), known):  # one after the other: factors of other nodes must not be kept
        signal[~mask] = np.nan  # never read
        smooth = smoother(signal, mask)
        system = np.diag(np.maximum(mask, 1e-9)) + laplacian(graph, strength)
        np.testing.assert_allclose(system @ smooth, np.where(mask[:, None], signal, 0.0), atol=1e-9)
        # What is left is a high-pass response: it changes no mean.
        np.testing.assert_allclose((signal - smooth)[mask].sum(axis=0), 0.0, atol=1e-4)


def test_a_constant_is_smooth_and_what_changes_from_node_to_node_is_not() -> None:
    angle = torch.linspace(0, 2 * torch.pi, 61)[:60]
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros(60)], dim=1)
    smoother, known = Smoother(build_graph(ring, num_neighbors=4), 8.0), np.ones(60, bool)
    slow, fast = np.sin(angle.numpy())[:, None], np.where(np.arange(60) % 2, 1.0, -1.0)[:, None]
    np.testing.assert_allclose(smoother(np.full((60, 2), 3.7), known), 3.7)
    assert np.abs(smoother(slow, known) - slow).max() < 0.1
    assert np.abs(smoother(fast, known)).max() < 0.1


def test_a_node_without_an_edge_keeps_its_value() -> None:
    graph = build_graph(torch.cat([cloud(), torch.tensor([[1e3, 0, 0], [0, 1e3, 0]])]), num_neighbors=6)
    assert graph.isolated.tolist()[-2:] == [True, True]
    known = np.arange(62) < 61
    smooth = Smoother(graph, 8.0)(np.full((62, 1), 2.0), known)
    assert smooth[60] == pytest.approx(2.0)
    assert smooth[61] == 0


def test_a_graph_without_edges_changes_nothing() -> None:
    graph = build_graph(cloud(5) * 1e3, num_neighbors=2, tau=0.0)
    signal = cloud(5, seed=1).numpy()
    np.testing.assert_allclose(Smoother(graph, 8.0)(signal, np.ones(5, bool)), signal)
