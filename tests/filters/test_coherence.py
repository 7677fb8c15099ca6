"""Local coherence by random vectors, against eigenvectors."""

from __future__ import annotations

import pytest
import scipy.sparse as sp
import torch
from torch import Tensor

from sundae_ns.errors import ConfigError
from sundae_ns.filters import cheby_moments, estimate_lmax, local_coherence
from sundae_ns.graphs import build_graph, laplacian


def graph(n: int = 300) -> sp.csr_matrix:
    generator = torch.Generator().manual_seed(0)
    return laplacian(build_graph(torch.rand(n, 3, generator=generator, dtype=torch.float64), num_neighbors=8))


def energies(L: sp.csr_matrix, rank: int) -> Tensor:
    """Energy of each node in the first eigenvectors, as Puy et al. define it."""
    U = torch.linalg.eigh(torch.from_numpy(L.toarray())).eigenvectors[:, :rank]
    return U.square().sum(dim=1)


@pytest.mark.parametrize("rank", [15, 60, 150])
def test_it_is_the_energy_in_the_low_band(rank: int) -> None:
    found, expected = local_coherence(graph(), rank, vectors=2000), energies(graph(), rank)
    assert float(found.sum()) == pytest.approx(rank)
    # The band has a soft end, and so values do not agree; what they say does: measured 0.95 and above.
    assert float(torch.corrcoef(torch.stack([found, expected]))[0, 1]) > 0.9


def test_the_cutoff_follows_the_rank() -> None:
    L = graph()
    lmax = estimate_lmax(L)
    probes = torch.randn(300, 500, dtype=torch.float64)
    moments = cheby_moments(L, probes, order=6, lmax=lmax)
    eigenvalues = torch.linalg.eigvalsh(torch.from_numpy(L.toarray()))
    exact = torch.stack([torch.cos(j * torch.acos((2 * eigenvalues / lmax - 1).clamp(-1, 1))).mean() for j in range(7)])
    torch.testing.assert_close(moments, exact, rtol=0, atol=0.02)
    assert cheby_moments(L, probes, order=0, lmax=lmax).tolist() == [1.0]


def test_sparse_regions_and_lone_nodes_carry_more_of_the_band() -> None:
    generator = torch.Generator().manual_seed(0)
    dense = 0.3 * torch.rand(400, 3, generator=generator)
    sparse = torch.rand(50, 3, generator=generator) + torch.tensor([0.35, 0, 0])
    points = torch.cat([dense, sparse, torch.tensor([[50.0, 0, 0]])])
    found = local_coherence(laplacian(build_graph(points, num_neighbors=8)), 45)
    assert found[400:450].mean() > 3 * found[:400].mean()
    assert found[450] > found[:400].max()


def test_it_is_the_same_from_run_to_run_and_follows_its_seed() -> None:
    assert torch.equal(local_coherence(graph(), 30, seed=3), local_coherence(graph(), 30, seed=3))
    assert not torch.equal(local_coherence(graph(), 30, seed=3), local_coherence(graph(), 30, seed=4))


def test_without_edges_and_in_the_whole_band_all_are_equal() -> None:
    assert local_coherence(sp.csr_matrix((5, 5)), 2).tolist() == [0.4] * 5
    assert local_coherence(graph(50), 50).tolist() == [1.0] * 50


@pytest.mark.parametrize(
    ("rank", "vectors", "message"), [(0, 4, "band of 0"), (301, 4, "1 to 300"), (5, 0, "at least 1")]
)
def test_what_cannot_work_is_said(rank: int, vectors: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        local_coherence(graph(), rank, vectors=vectors)


@pytest.mark.gpu
def test_cpu_and_gpu_agree() -> None:
    on_gpu = local_coherence(graph(), 30, device="cuda")
    assert on_gpu.is_cuda
    torch.testing.assert_close(on_gpu.cpu(), local_coherence(graph(), 30), rtol=1e-9, atol=1e-12)
