"""The kernel of a chain's noise, compiled for the CPU, beside PyTorch's operations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from sundae_ns.gaussians import relocation
from sundae_ns.gpu import fused_noise


def field(n: int) -> dict[str, torch.Tensor]:
    quats = torch.randn(n, 4)
    quats[0] = 0
    return {
        "means": torch.randn(n, 3),
        "scales": torch.randn(n, 3) - 2,
        "quats": quats,
        "opacities": torch.linspace(-12, 12, n)[:, None],
    }


def test_it_moves_centres_as_pytorch_does(load_on_cpu: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    params = field(777)
    before = params["means"].clone()
    expected = {name: value.double() for name, value in params.items()}
    noise = torch.randn(777, 3)
    monkeypatch.setattr(torch, "randn_like", lambda value: noise.to(value.dtype))
    relocation.jitter(expected, 0.7)
    kernels = load_on_cpu("noise.cu", ("add_noise",), (), torch.device("cpu"), fused_noise.THREADS)
    shape = (params["scales"], params["quats"], params["opacities"])
    fused_noise.add_noise(kernels, params["means"], *shape, noise, 0.7, relocation.GATE)
    moved, exact = params["means"].double() - before, expected["means"] - before
    torch.testing.assert_close(moved, exact, rtol=1e-4, atol=1e-6)
    assert exact[0].abs().max() > 1e-3  # a quaternion of zeros turns nothing, and its noise counts
    assert exact[-1].abs().max() < 1e-6


def test_it_compiles_for_gpus(compile_for_gpu: Callable[..., bytes]) -> None:
    assert compile_for_gpu("noise.cu", "sm_75", ())


@pytest.mark.gpu
def test_on_a_gpu_it_moves_centres_as_on_a_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    params = field(5000)
    moved = {name: value.cuda() for name, value in params.items()}
    noise = torch.randn(5000, 3)
    monkeypatch.setattr(torch, "randn_like", lambda value: noise.to(value.device))
    relocation.jitter(moved, 0.7)
    relocation.jitter(params, 0.7)
    torch.testing.assert_close(moved["means"].cpu(), params["means"], rtol=1e-4, atol=1e-5)
