"""Adam's kernel, compiled for the CPU, beside torch's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from sundae_ns.gpu import fused_adam

N = 1000
BETAS = (0.9, 0.999)


@pytest.fixture(autouse=True)
def on_cpu(load_on_cpu: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused_adam, "load_kernels", load_on_cpu)


def test_it_follows_torch() -> None:
    """Over gradients of all sizes, with vanishing ones, and with a rate that changes."""
    value = torch.randn(N)
    exact = torch.nn.Parameter(value.double())
    optimizer = torch.optim.Adam([exact], lr=1.0, betas=BETAS, eps=1e-15)
    mean, square, step = torch.zeros(N), torch.zeros(N), torch.zeros(())
    scales = 10 ** (torch.rand(N) * 12 - 10)
    scales[:10] = 0
    for count in range(1, 30):
        gradient, rate = torch.randn(N) * scales, 0.01 / count
        step += 1
        update = fused_adam.Update(value, gradient, mean, square, step)
        fused_adam.adam(update, torch.tensor(rate), None, betas=BETAS, eps=1e-15)
        optimizer.param_groups[0]["lr"], exact.grad = rate, gradient.double()
        optimizer.step()
    torch.testing.assert_close(value.double(), exact.detach(), rtol=0, atol=2e-6)
    state = optimizer.state[exact]
    torch.testing.assert_close(mean.double(), state["exp_avg"], rtol=1e-3, atol=1e-12)
    torch.testing.assert_close(square.double(), state["exp_avg_sq"], rtol=1e-4, atol=1e-20)


def test_a_skipped_step_changes_nothing() -> None:
    tensors = [torch.ones(N) for _ in range(4)]
    before = [value.clone() for value in tensors]
    one, rate = torch.ones(()), torch.tensor(0.1)
    update = fused_adam.Update(tensors[0], tensors[1], tensors[2], tensors[3], one)
    fused_adam.adam(update, rate, one, betas=BETAS, eps=1e-8)
    assert all(torch.equal(value, old) for value, old in zip(tensors, before, strict=True))
    fused_adam.adam(update, rate, torch.zeros(()), betas=BETAS, eps=1e-8)
    assert (tensors[0] != before[0]).all()


def test_it_compiles_for_gpus(compile_for_gpu: Callable[..., bytes]) -> None:
    assert compile_for_gpu("adam.cu", "sm_75", fused_adam.OPTIONS)
