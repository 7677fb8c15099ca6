"""The compiled harmonics against their oracle, the reference: values, gradients, layouts and threads."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sundae_ns.errors import BackendError
from sundae_ns.rasterization import select_backend, spherical_harmonics
from sundae_ns.rasterization.cpu import backend

CPU, REFERENCE = select_backend("cpu", "cpu"), select_backend("reference", "cpu")


def graded(degree: int, directions: Tensor, coeffs: Tensor, backend: object) -> list[Tensor]:
    """Values, and the gradients of a random functional of them."""
    leaves = [value.detach().clone().requires_grad_() for value in (directions, coeffs)]
    value = spherical_harmonics(degree, *leaves, backend=backend)  # type: ignore[arg-type]
    weights = torch.randn(value.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    weights[::5] = 0  # primitives that no pixel sees
    grads = torch.autograd.grad((value * weights).sum(), leaves, materialize_grads=True)
    return [value.detach(), *grads]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_values_and_gradients_match_the_oracle(degree: int, dtype: torch.dtype) -> None:
    directions, coeffs = 3 * torch.randn(200, 3, dtype=dtype), torch.randn(200, 25, 3, dtype=dtype)
    directions[0] = 0
    bound = 1e-13 if dtype == torch.float64 else 1e-6
    exact = graded(degree, directions.double(), coeffs.double(), REFERENCE)
    for found, expected in zip(graded(degree, directions, coeffs, CPU), exact, strict=True):
        assert found.dtype == dtype
        assert (found - expected).norm() <= bound * expected.norm()


def test_layouts_that_are_not_contiguous() -> None:
    directions, coeffs = torch.randn(3, 40).T, torch.randn(16, 40, 3).transpose(0, 1)
    found = graded(3, directions, coeffs, CPU)
    for ours, expected in zip(found, graded(3, directions.contiguous(), coeffs.contiguous(), CPU), strict=True):
        assert torch.equal(ours, expected)


def test_only_what_needs_a_gradient_gets_one() -> None:
    directions, coeffs = torch.randn(8, 3), torch.randn(8, 9, 3, requires_grad=True)
    spherical_harmonics(2, directions, coeffs, backend=CPU).sum().backward()
    assert directions.grad is None
    assert coeffs.grad is not None
    with torch.no_grad():
        assert not spherical_harmonics(2, directions, coeffs, backend=CPU).requires_grad


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    directions, coeffs = torch.randn(500, 3), torch.randn(500, 16, 3)
    one = graded(3, directions, coeffs, CPU)
    monkeypatch.setattr(backend, "_MIN_TO_EVALUATE", 1)
    monkeypatch.setattr("sundae_ns.rasterization.cpu.parallel.torch.get_num_threads", lambda: 3)
    for ours, expected in zip(graded(3, directions, coeffs, CPU), one, strict=True):
        assert torch.equal(ours, expected)


def test_unsupported_dtypes_are_refused() -> None:
    with pytest.raises(BackendError, match="float32 or float64"):
        spherical_harmonics(1, torch.ones(2, 3).half(), torch.ones(2, 4, 3).half(), backend=CPU)
