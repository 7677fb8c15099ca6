"""Surgery on a field in training: removal, copies, snapshots; complete, and without effect on error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from sundae_ns.core.errors import DataError
from sundae_ns.core.surgery import check_wiring, grow, keep, module_snapshot, restore, restore_module, snapshot

SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "features_rest": (8, 3), "opacities": (1,), "features": (13,)}


def gaussians(n: int = 20, seed: int = 0) -> tuple[dict[str, Parameter], dict[str, Optimizer]]:
    generator = torch.Generator().manual_seed(seed)
    params = {name: Parameter(torch.randn(n, *shape, generator=generator)) for name, shape in SHAPES.items()}
    params["quats"].requires_grad_(False)
    optimizers: dict[str, Optimizer] = {
        name: Adam([{"params": value, "lr": 0.1}], eps=1e-15) for name, value in params.items() if name != "quats"
    }
    network = torch.nn.Linear(n, n)
    optimizers["compensation"] = Adam(network.parameters())
    return params, optimizers


def train(params: Mapping[str, Tensor], optimizers: Mapping[str, Optimizer], steps: int = 1) -> float:
    """Steps towards ones; the last loss."""
    for _ in range(steps):
        loss = torch.stack([(value - 1).square().sum() for value in params.values() if value.requires_grad]).sum()
        for optimizer in optimizers.values():
            optimizer.zero_grad()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
    return loss.item()


def some(n: int = 20) -> Tensor:
    return torch.arange(n) % 3 == 0


def moments(optimizers: Mapping[str, Optimizer], params: Mapping[str, Tensor], name: str) -> Tensor:
    return optimizers[name].state[params[name]]["exp_avg"]


# -------------------------------------------------------------------------------------------------------------- removal


def test_training_continues_as_if_only_the_kept_primitives_had_existed() -> None:
    (params, optimizers), (expected, expected_optimizers) = gaussians(), gaussians()
    still_alive = params["means"].exp().sum()
    keep(expected, expected_optimizers, [], some())
    for held, holders in ((params, optimizers), (expected, expected_optimizers)):
        train(held, holders, 3)
    keep(params, optimizers, [], some())
    for held, holders in ((params, optimizers), (expected, expected_optimizers)):
        train(held, holders, 3)
    for name, value in params.items():
        assert value.shape == (7, *SHAPES[name])
        torch.testing.assert_close(value, expected[name])
    assert still_alive.grad_fn is not None  # a live graph of an earlier step does not break training


def test_optimizers_hold_the_new_parameters_and_sliced_moments() -> None:
    params, optimizers = gaussians()
    params = torch.nn.ParameterDict(params)  # type: ignore[assignment]
    train(params, optimizers)
    old = dict(params.items())
    before = {name: moments(optimizers, params, name).clone() for name in SHAPES if name != "quats"}
    keep(params, optimizers, [], some())
    for name, value in params.items():
        torch.testing.assert_close(value.data, old[name].data[some()])
        assert isinstance(value, Parameter)
        assert value.requires_grad == (name != "quats")
        if name == "quats":
            continue
        state = optimizers[name].state
        assert list(state) == [value]
        assert optimizers[name].param_groups[0]["params"][0] is value
        assert optimizers[name].param_groups[0]["lr"] == 0.1
        assert int(state[value]["step"]) == 1
        assert torch.equal(state[value]["exp_avg"], before[name][some()])
        assert state[value]["exp_avg_sq"].shape == value.shape


def test_per_primitive_state_is_sliced_and_other_state_is_unchanged() -> None:
    params, optimizers = gaussians()
    rest: dict[str, Any] = {"other": torch.rand(5), "step": 20, "no": None, "scalar": torch.tensor(20)}
    state, alone = {"grad2d": torch.arange(20), **rest}, {"pair": torch.rand(20, 2), **rest}
    network = [p.detach().clone() for p in optimizers["compensation"].param_groups[0]["params"]]
    keep(params, optimizers, [state, alone], some())
    assert state["grad2d"].tolist() == [0, 3, 6, 9, 12, 15, 18]
    assert alone["pair"].shape == (7, 2)
    assert all(each[name] is value for each in (state, alone) for name, value in rest.items())
    for value, before in zip(optimizers["compensation"].param_groups[0]["params"], network, strict=True):
        assert torch.equal(value, before)


def test_a_one_element_step_of_one_primitive_is_not_sliced() -> None:
    params, optimizers = gaussians(1)
    train(params, optimizers)
    step = optimizers["means"].state[params["means"]]["step"] = torch.ones(1)
    keep(params, optimizers, [], torch.tensor([True]))
    assert optimizers["means"].state[params["means"]]["step"] is step


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (torch.zeros(20, dtype=torch.bool), "removes all 20"),
        (torch.ones(19, dtype=torch.bool), r"\[19\] for 20"),
        (torch.ones(20, 1, dtype=torch.bool), r"\[20, 1\] for 20"),
        (torch.ones(20), "float32"),
    ],
)
def test_wrong_masks_are_refused(mask: Tensor, message: str) -> None:
    params, optimizers = gaussians()
    with pytest.raises(DataError, match=message):
        keep(params, optimizers, [], mask)


@pytest.mark.parametrize("fault", ["length", "stale", "two groups"])
def test_nothing_changes_on_error(fault: str) -> None:
    params, optimizers = gaussians()
    train(params, optimizers)
    if fault == "length":
        params["features"] = Parameter(torch.zeros(19, 13))
        del optimizers["features"]
    elif fault == "stale":
        optimizers["features"] = Adam([Parameter(torch.zeros(20, 13))])
    else:
        optimizers["features"].add_param_group({"params": [Parameter(torch.zeros(3))]})
    objects = dict(params)
    state: dict[str, Any] = {"grad2d": torch.arange(20)}
    with pytest.raises(DataError, match="'features'"):
        keep(params, optimizers, [state], some())
    with pytest.raises(DataError, match="'features'"):
        check_wiring(params, optimizers)
    assert all(params[name] is objects[name] for name in objects)
    assert optimizers["means"].state[params["means"]]["exp_avg"].shape == (20, 3)
    assert state["grad2d"].shape == (20,)


@pytest.mark.gpu
def test_a_mask_on_the_cpu_prunes_a_field_on_the_gpu() -> None:
    params = {name: Parameter(value.detach().cuda()) for name, value in gaussians()[0].items()}
    optimizers: dict[str, Optimizer] = {name: Adam([value]) for name, value in params.items()}
    train(params, optimizers)
    keep(params, optimizers, [], some())
    train(params, optimizers)
    assert params["means"].is_cuda
    assert len(params["means"]) == 7


# ------------------------------------------------------------------------------------------------------------ snapshots


def test_training_continues_from_a_snapshot_bit_for_bit() -> None:
    params, optimizers = gaussians()
    train(params, optimizers, 3)
    saved = snapshot(params, optimizers)
    train(params, optimizers, 4)
    expected = {name: value.detach().clone() for name, value in params.items()}
    keep(params, optimizers, [], torch.arange(20) < 7)
    train(params, optimizers, 5)
    for _ in range(2):  # a snapshot can be restored more than once
        restore(params, optimizers, saved)
        for name in SHAPES.keys() & optimizers.keys():
            assert optimizers[name].param_groups[0]["params"] == [params[name]]
            assert list(optimizers[name].state) == [params[name]]
        train(params, optimizers, 4)
        assert all(torch.equal(value, expected[name]) for name, value in params.items())


def test_a_snapshot_before_the_first_step_has_no_moments() -> None:
    params, optimizers = gaussians()
    saved = snapshot(params, optimizers)
    train(params, optimizers)
    del optimizers["means"]
    restore(params, optimizers, saved)
    assert not any(optimizers[name].state for name in SHAPES.keys() & optimizers.keys())
    train(params, optimizers)


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


# --------------------------------------------------------------------------------------------------------------- copies


def integral(opacity: float, scale: float, copies: int) -> float:
    """Integral along a line of the opacity of ``copies`` Gaussians at one place, by the midpoint rule."""
    x = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 20_000 * 24 - 12
    alpha = opacity * torch.exp(-0.5 * (x / scale) ** 2)
    return float((1 - (1 - alpha) ** copies).sum() * 24 / 20_000)


@given(st.floats(0.02, 0.99))
def test_copies_render_like_the_original(opacity: float) -> None:
    params = {
        "means": Parameter(torch.zeros(1, 3, dtype=torch.float64)),
        "scales": Parameter(torch.zeros(1, 3, dtype=torch.float64)),
        "opacities": Parameter(torch.logit(torch.tensor([[opacity]], dtype=torch.float64))),
    }
    grow(params, {}, 1, 0.005)
    new, scale = params["opacities"].detach().sigmoid()[:, 0], params["scales"].detach().exp()
    assert new[0] == new[1]
    assert torch.equal(scale[0], scale[1])
    assert 1 - (1 - float(new[0])) ** 2 == pytest.approx(opacity, rel=1e-9)
    assert integral(float(new[0]), float(scale[0, 0]), 2) == pytest.approx(integral(opacity, 1.0, 1), rel=1e-6)


@pytest.mark.parametrize("count", [0, 7, 30, 95])
def test_growing_adds_the_exact_number_upon_the_most_opaque(count: int) -> None:
    params, optimizers = gaussians(30)
    train(params, optimizers)
    old, before = params["means"].detach().clone(), moments(optimizers, params, "features").clone()
    opaque = params["opacities"].detach().flatten().argsort(descending=True)
    grow(params, optimizers, count, 0.005)
    assert {len(value) for value in params.values()} == {30 + count}
    assert all(value.isfinite().all() for value in params.values())
    for name in SHAPES.keys() & optimizers.keys():
        assert optimizers[name].param_groups[0]["params"] == [params[name]]
        assert moments(optimizers, params, name).shape == params[name].shape
    assert torch.equal(params["means"][:30], old)
    assert torch.equal(params["means"][30:60], old[opaque[: min(count, 30)]])
    assert torch.equal(moments(optimizers, params, "features")[:30], before)
    assert not moments(optimizers, params, "features")[30:].any()
