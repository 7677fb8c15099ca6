"""Snapshots of a field: values and moments come back, and training continues bit for bit."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import Parameter
from torch.optim import Adam

from sundae_ns.gaussians.surgery import keep, module_snapshot, narrow, restore, restore_module, snapshot


def field(n: int = 20) -> tuple[dict[str, Parameter], dict[str, Adam]]:
    shapes = {"means": (3,), "features_rest": (8, 3), "opacities": (1,)}
    params = {name: Parameter(torch.randn(n, *shape)) for name, shape in shapes.items()}
    return params, {name: Adam([value], lr=0.1) for name, value in params.items()}


def train(params: dict[str, Parameter], optimizers: dict[str, Adam], steps: int) -> None:
    for _ in range(steps):
        for optimizer in optimizers.values():
            optimizer.zero_grad()
        torch.stack([(value - 1).square().sum() for value in params.values()]).sum().backward()
        for optimizer in optimizers.values():
            optimizer.step()


def test_training_continues_from_a_snapshot_bit_for_bit() -> None:
    params, optimizers = field()
    train(params, optimizers, 3)
    saved = snapshot(params, optimizers)
    train(params, optimizers, 4)
    expected = {name: value.detach().clone() for name, value in params.items()}

    keep(params, optimizers, [], torch.arange(20) < 7)
    narrow(params, optimizers, "features_rest", 3)
    train(params, optimizers, 5)
    for _ in range(2):  # a snapshot can be restored more than once
        restore(params, optimizers, saved)
        for name, value in params.items():
            assert optimizers[name].param_groups[0]["params"] == [value]
            assert list(optimizers[name].state) == [value]
        train(params, optimizers, 4)
        for name, value in params.items():
            assert torch.equal(value, expected[name]), name


def test_snapshot_before_the_first_step_has_no_moments() -> None:
    params, optimizers = field()
    saved = snapshot(params, optimizers)
    train(params, optimizers, 1)
    del optimizers["means"]
    restore(params, optimizers, saved)
    assert not any(optimizer.state for optimizer in optimizers.values())
    train(params, optimizers, 1)


def test_narrow_keeps_the_first_columns_and_their_moments() -> None:
    params, optimizers = field()
    train(params, optimizers, 2)
    wide, moments = params["features_rest"].detach().clone(), optimizers["features_rest"].state[params["features_rest"]]
    for steps, width in ((2, 3), (3, 0)):
        narrow(params, optimizers, "features_rest", width)
        value = params["features_rest"]
        assert torch.equal(value, wide[:, :width])
        state = optimizers["features_rest"].state[value]
        assert torch.equal(state["exp_avg"], moments["exp_avg"][:, :width])
        assert state["step"] == steps
        train(params, optimizers, 1)
        assert params["features_rest"].shape == (20, width, 3)
        wide[:, :width] = params["features_rest"].detach()
        moments = optimizers["features_rest"].state[params["features_rest"]]


def test_a_network_is_restored_in_place() -> None:
    net = nn.Sequential(nn.Linear(3, 4), nn.Linear(4, 1))
    optimizer = Adam(net.parameters())

    def steps(count: int) -> None:
        for _ in range(count):
            optimizer.zero_grad()
            net(torch.ones(2, 3)).square().sum().backward()
            optimizer.step()

    steps(3)
    saved, objects = module_snapshot(net.parameters(), optimizer), list(net.parameters())
    steps(4)
    expected = [value.detach().clone() for value in net.parameters()]
    steps(2)
    restore_module(net.parameters(), optimizer, saved)
    assert all(a is b for a, b in zip(objects, net.parameters()))
    steps(4)
    assert all(torch.equal(a, b) for a, b in zip(expected, net.parameters()))
