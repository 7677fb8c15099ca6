"""Adam of the method: nerfstudio's options, stock arithmetic on a CPU, fused on CUDA."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig

from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.method_configs import sundae
from sundae_ns.plugin.optimizer_configs import FusedAdamConfig, NetworkAdamConfig, PruneAwareDecayConfig
from sundae_ns.train.schedules import notify_pruned


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


def step_at_a_long_gradient(config: AdamOptimizerConfig) -> float:
    """How far a weight moves, in rates, by the first long gradient after thousands of short ones."""
    value = torch.nn.Parameter(torch.zeros(1))
    optimizer = config.setup([value])
    for step in range(5000):
        value.grad = torch.full((1,), 1e-4 * (-1) ** step)
        optimizer.step()
    before, value.grad = value.item(), torch.ones(1)
    optimizer.step()
    return abs(value.item() - before) / config.lr


def test_a_long_gradient_moves_a_networks_weights_by_less_than_the_rate() -> None:
    assert step_at_a_long_gradient(FusedAdamConfig(lr=1e-3)) > 3
    assert step_at_a_long_gradient(NetworkAdamConfig(lr=1e-3)) < 0.5


def test_weights_of_many_inputs_have_smaller_rates() -> None:
    head = CompensationHead(HeadConfig(size="regular", pixel_unshuffle=1))
    optimizer = NetworkAdamConfig(lr=1e-3, full_rate_inputs=1152).setup(head.parameters())
    rates = {value: group["lr"] for group in optimizer.param_groups for value in group["params"]}
    assert len(rates) == len(list(head.parameters()))
    for conv in (module for module in head.modules() if isinstance(module, torch.nn.Conv2d)):
        inputs = conv.in_channels * conv.kernel_size[0] ** 2
        assert rates[conv.weight] == pytest.approx(1e-3 * min(1, 1152 / inputs))
        assert conv.bias is not None
        assert rates[conv.bias] == 1e-3
    assert min(rates.values()) == pytest.approx(1e-3 / 6)  # 3 x 3 of 512 + 256 channels


def test_the_default_head_has_one_rate_and_its_biases_do_not_decay() -> None:
    config = sundae.config.optimizers["compensation"]["optimizer"]
    optimizer = config.setup(CompensationHead(HeadConfig()).parameters())
    assert {(group["lr"], group["betas"]) for group in optimizer.param_groups} == {(1e-3, (0.9, 0.95))}
    decays = {value.ndim > 1: group["weight_decay"] for group in optimizer.param_groups for value in group["params"]}
    assert decays == {True: 0.15, False: 0}


def test_a_networks_weights_decay_by_a_share_of_the_rate() -> None:
    net = torch.nn.Linear(2, 2)
    before = [value.detach().clone() for value in (net.weight, net.bias)]
    optimizer = NetworkAdamConfig(lr=0.1, weight_decay=0.5).setup(net.parameters())
    for value in net.parameters():
        value.grad = torch.zeros_like(value)
    optimizer.step()
    torch.testing.assert_close(net.weight.detach(), 0.95 * before[0])
    assert torch.equal(net.bias.detach(), before[1])


def test_rates_of_all_layers_decay_alike_and_come_back_from_a_checkpoint() -> None:
    def made() -> tuple[torch.optim.Optimizer, Any]:
        head = CompensationHead(HeadConfig(size="regular"))
        optimizer = NetworkAdamConfig(lr=1e-3).setup(head.parameters())
        config = PruneAwareDecayConfig(lr_final=1e-5, max_steps=100, lr_restart=1e-3, hold_until_prune=True)
        return optimizer, config.setup().get_scheduler(optimizer, 1e-3)

    optimizer, scheduler = made()
    highest = [group["lr"] for group in optimizer.param_groups]
    assert len(highest) > 1
    notify_pruned({"compensation": scheduler}, 0, 100)
    for _ in range(50):
        optimizer.step()
        scheduler.step()
    rates = [group["lr"] for group in optimizer.param_groups]
    assert rates == pytest.approx([0.1 * rate for rate in highest])
    again, schedule = made()
    again.load_state_dict(optimizer.state_dict())
    schedule.load_state_dict(scheduler.state_dict())
    for each in (optimizer, scheduler, again, schedule):
        each.step()
    assert [group["lr"] for group in again.param_groups] == [group["lr"] for group in optimizer.param_groups]
    assert optimizer.param_groups[0]["lr"] < rates[0]


@pytest.mark.gpu
def test_fused_on_cuda_takes_the_same_steps() -> None:
    config = FusedAdamConfig(lr=0.03)
    assert config.setup([torch.nn.Parameter(torch.zeros(1, device="cuda"))]).param_groups[0]["fused"]
    torch.testing.assert_close(trained(config, "cuda"), trained(config), atol=1e-6, rtol=1e-5)
