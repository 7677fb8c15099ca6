"""Chebyshev filters against eigenvectors, their kernels, and the estimate that they rest on."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sundae_ns.errors import ConfigError, DataError
from sundae_ns.filters import (
    Kernel,
    band_pass_kernel,
    cheby_filter,
    compute_cheby_coeff,
    estimate_lmax,
    exact_filter,
    high_pass,
    high_pass_kernel,
    low_pass_kernel,
)
from sundae_ns.graphs import LapType, build_graph, laplacian

KERNELS = [low_pass_kernel, high_pass_kernel, band_pass_kernel]


def cloud(n: int = 300, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def made(lap_type: LapType = "normalized", n: int = 300) -> sp.csr_matrix:
    """Laplacian of a field with a node on its own."""
    return laplacian(build_graph(torch.cat([cloud(n - 1), torch.full((1, 3), 1e4)]), num_neighbors=8), lap_type)


def sup_error(kernel: Kernel, lmax: float, order: int) -> float:
    """Largest difference of kernel and polynomial on a fine grid."""
    grid = torch.linspace(0, lmax, 20_001, dtype=torch.float64)
    series = np.polynomial.chebyshev.chebval(2 * grid.numpy() / lmax - 1, compute_cheby_coeff(kernel, lmax, order))
    return float(np.abs(series - kernel(grid).numpy()).max())


@pytest.mark.parametrize("lap_type", ["normalized", "combinatorial"])
@pytest.mark.parametrize("make", KERNELS)
def test_the_error_is_within_its_bound_and_falls_with_the_order(make: type, lap_type: LapType) -> None:
    L, x = made(lap_type), cloud(seed=1)
    lmax = estimate_lmax(L)
    kernel = make(lmax)
    exact = exact_filter(L, x, kernel)
    errors = []
    for order in (2, 8, 20, 40, 80):
        error = torch.linalg.matrix_norm(cheby_filter(L, x, kernel, order=order, lmax=lmax) - exact, 2)
        assert error <= sup_error(kernel, lmax, order) * torch.linalg.matrix_norm(x, 2) + 1e-12
        errors.append(float(error))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-12 * float(x.norm())  # measured 3.6e-15


@pytest.mark.parametrize("order", [0, 1, 2, 3, 7])
def test_polynomials_up_to_the_order_are_exact(order: int) -> None:
    L, x = made(), cloud(seed=1)
    weights = [0.5, -1.0, 0.25, 2.0, -0.5, 1.5, -0.125, 0.75][: order + 1]
    direct, power = torch.zeros_like(x), x
    for weight in weights:
        direct += weight * power
        power = torch.from_numpy(L @ power.numpy())

    def kernel(eigenvalues: torch.Tensor) -> torch.Tensor:
        return sum(weight * eigenvalues**j for j, weight in enumerate(weights))  # type: ignore[return-value]

    torch.testing.assert_close(cheby_filter(L, x, kernel, order=order), direct, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(exact_filter(L, x, kernel), direct, rtol=1e-10, atol=1e-10)


def test_the_papers_high_pass_is_the_kernel_lambda() -> None:
    # I - A and the normalised Laplacian are similar: L = D^1/2 (I - A) D^-1/2, where all neighbours are mutual.
    points = cloud(40)
    graph = build_graph(points, num_neighbors=39, tau=100.0, sigma=1.0)
    root = graph.dw.sqrt()[:, None]
    filtered = cheby_filter(laplacian(graph, "normalized"), root * points, lambda e: e, order=1) / root
    torch.testing.assert_close(filtered, high_pass(graph, points), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("lap_type", ["normalized", "combinatorial"])
@pytest.mark.parametrize("n", [2, 40, 64, 65, 300])
def test_the_estimate_covers_the_spectrum_closely(lap_type: LapType, n: int) -> None:
    L = laplacian(build_graph(cloud(n), num_neighbors=min(8, n - 1), tau=1e3), lap_type)
    largest = np.linalg.eigvalsh(L.toarray())[-1]
    estimate = estimate_lmax(L)
    assert largest * (1 - 1e-12) <= estimate <= 1.01 * largest
    assert estimate == estimate_lmax(L)


def test_graphs_without_edges() -> None:
    for n in (0, 1, 100):
        L = sp.csr_matrix((n, n))
        assert estimate_lmax(L) == 0
        x = torch.ones(n, 2)
        for order in (0, 5):
            torch.testing.assert_close(cheby_filter(L, x, lambda e: 3 + e, order=order), 3 * x)
        assert torch.equal(exact_filter(L, x, lambda e: 3 + e), 3 * x)


def test_low_band_and_high_pass_share_every_frequency() -> None:
    grid = torch.linspace(0, 3, 1000, dtype=torch.float64)
    low, high = low_pass_kernel(3.0, 0.3, 0.05)(grid), high_pass_kernel(3.0, 0.8, 0.05)(grid)
    band = band_pass_kernel(3.0, 0.3, 0.8, 0.05)(grid)
    torch.testing.assert_close(low + band + high, torch.ones_like(grid))
    assert low[0] > 0.999
    assert high[0] < 1e-9
    assert band[550] > 0.999
    assert (low.diff() <= 0).all()
    assert low_pass_kernel(3.0, 0.5, 0.1)(torch.tensor([1.5])).item() == 0.5


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 12), st.sampled_from(KERNELS), st.integers(1, 4))
def test_linear_and_equivariant(order: int, make: type, columns: int) -> None:
    L = made(n=80)
    x, y = torch.randn(80, columns).double(), torch.randn(80, columns).double()
    shuffle = torch.randperm(80)
    kernel = make(2.0)

    def filtered(L: sp.csr_matrix, x: torch.Tensor) -> torch.Tensor:
        return cheby_filter(L, x, kernel, order=order, lmax=2.0)

    torch.testing.assert_close(filtered(L, 2 * x - y), 2 * filtered(L, x) - filtered(L, y))
    permuted = L[shuffle.numpy()][:, shuffle.numpy()]
    torch.testing.assert_close(filtered(permuted, x[shuffle]), filtered(L, x)[shuffle])


def test_shapes_and_dtypes() -> None:
    L = made()
    kernel = low_pass_kernel(2.0)
    x = cloud(seed=1)
    whole = cheby_filter(L, x, kernel)
    for function in (cheby_filter, exact_filter):
        assert function(L, x[:, 0], kernel).shape == (300,)
        single = function(L, x.float(), kernel)
        assert single.dtype == torch.float32
        torch.testing.assert_close(single.double(), whole, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(cheby_filter(L, x[:, 1], kernel), whole[:, 1])
    assert compute_cheby_coeff(kernel, 2.0, 12).shape == (13,)


def test_wrong_input_is_refused() -> None:
    L, x = made(), cloud()
    for wrong in ({"lmax": 0.0}, {"lmax": float("nan")}, {"cutoff": 1.5}, {"width": 0.0}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            low_pass_kernel(**{"lmax": 2.0, **wrong})
    with pytest.raises(ConfigError, match="empty"):
        band_pass_kernel(2.0, 0.6, 0.4)
    with pytest.raises(ConfigError, match="order"):
        cheby_filter(L, x, low_pass_kernel(2.0), order=-1)
    with pytest.raises(ConfigError, match="lmax"):
        compute_cheby_coeff(low_pass_kernel(2.0), -1.0)
    with pytest.raises(ConfigError, match="cheby_filter"):
        exact_filter(sp.identity(5000).tocsr(), torch.zeros(5000), low_pass_kernel(2.0))
    with pytest.raises(DataError, match="kernel is not finite"):
        cheby_filter(L, x, lambda e: 1 / (e - e))
    with pytest.raises(DataError, match="300 nodes"):
        cheby_filter(L, x[:5], low_pass_kernel(2.0))
    with pytest.raises(DataError, match="square"):
        estimate_lmax(L[:5])
    with pytest.raises(DataError, match="finite"):
        estimate_lmax(L * np.nan)


@pytest.mark.gpu
def test_the_same_on_a_gpu() -> None:
    L, x = made(), cloud(seed=1)
    kernel = band_pass_kernel(2.0)
    on_gpu = cheby_filter(L, x.cuda(), kernel)
    assert on_gpu.is_cuda
    torch.testing.assert_close(on_gpu.cpu(), cheby_filter(L, x, kernel), rtol=1e-12, atol=1e-12)
    assert exact_filter(L, x.cuda(), kernel).is_cuda
