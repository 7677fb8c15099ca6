"""Adam of the method: nerfstudio's options, stock arithmetic on a CPU, fused on CUDA."""

from __future__ import annotations

import pytest
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig

from sundae_ns.optimizers import FusedAdamConfig


def trained(config: AdamOptimizerConfig, device: str = "cpu") -> torch.Tensor:
    value = torch.nn.Parameter(torch.linspace(-1, 1, 7, device=device))
    optimizer = config.setup([value])
    for _ in range(20):
        optimizer.zero_grad()
        (value - 0.3).square().sum().backward()
        optimizer.step()
    return value.detach().cpu()


def test_same_steps_as_nerfstudios_adam() -> None:
    options = {"lr": 0.03, "eps": 1e-12, "weight_decay": 0.01}
    assert torch.equal(trained(FusedAdamConfig(**options)), trained(AdamOptimizerConfig(**options)))


def test_options_arrive_and_a_generator_of_parameters_will_do() -> None:
    config = FusedAdamConfig(lr=0.03, eps=1e-12, weight_decay=0.01)
    optimizer = config.setup(torch.nn.Linear(2, 2).parameters())
    group = optimizer.param_groups[0]
    assert (group["lr"], group["eps"], group["weight_decay"], group["fused"]) == (0.03, 1e-12, 0.01, False)
    assert len(group["params"]) == 2


@pytest.mark.gpu
def test_fused_on_cuda_takes_the_same_steps() -> None:
    config = FusedAdamConfig(lr=0.03)
    assert config.setup([torch.nn.Parameter(torch.zeros(1, device="cuda"))]).param_groups[0]["fused"]
    torch.testing.assert_close(trained(config, "cuda"), trained(config), atol=1e-6, rtol=1e-5)
