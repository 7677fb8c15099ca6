"""Removal of primitives from a field during training: complete, and without effect on error."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter

from sundae_ns.errors import DataError
from sundae_ns.gaussians.surgery import check_wiring, keep

SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "features_rest": (8, 3), "opacities": (1,), "features": (13,)}


def field(n: int = 20, seed: int = 0) -> tuple[dict[str, Parameter], dict[str, torch.optim.Optimizer]]:
    generator = torch.Generator().manual_seed(seed)
    params = {name: Parameter(torch.randn(n, *shape, generator=generator)) for name, shape in SHAPES.items()}
    params["quats"].requires_grad_(False)
    optimizers: dict[str, torch.optim.Optimizer] = {
        name: torch.optim.Adam([{"params": value, "lr": 0.1}], eps=1e-15)
        for name, value in params.items()
        if name != "quats"
    }
    network = torch.nn.Linear(n, n)
    optimizers["compensation"] = torch.optim.Adam(network.parameters())
    return params, optimizers


def train(params: dict[str, Parameter], optimizers: dict[str, torch.optim.Optimizer]) -> float:
    loss = sum(value.square().sum() for value in params.values() if value.requires_grad)
    assert isinstance(loss, Tensor)
    for optimizer in optimizers.values():
        optimizer.zero_grad()
    loss.backward()
    for optimizer in optimizers.values():
        optimizer.step()
    return loss.item()


def some(n: int = 20) -> Tensor:
    return torch.arange(n) % 3 == 0


def test_training_continues_as_if_only_the_kept_primitives_had_existed() -> None:
    params, optimizers = field()
    expected, expected_optimizers = field()
    keep(expected, expected_optimizers, [], some())
    for _ in range(3):
        train(params, optimizers)
        train(expected, expected_optimizers)
    keep(params, optimizers, [], some())
    for _ in range(3):
        train(params, optimizers)
        train(expected, expected_optimizers)
    for name, value in params.items():
        assert value.shape == (7, *SHAPES[name])
        torch.testing.assert_close(value, expected[name])


def test_optimizers_hold_the_new_parameters_and_sliced_moments() -> None:
    params, optimizers = field()
    train(params, optimizers)
    old = dict(params)
    moments = {name: optimizers[name].state[params[name]]["exp_avg"].clone() for name in SHAPES if name != "quats"}
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
        assert torch.equal(state[value]["exp_avg"], moments[name][some()])
        assert state[value]["exp_avg_sq"].shape == value.shape


def test_a_live_graph_of_the_previous_step_does_not_break_training() -> None:
    params, optimizers = field()
    still_alive = params["means"].exp().sum()
    train(params, optimizers)
    keep(params, optimizers, [], some())
    before = train(params, optimizers)
    assert train(params, optimizers) < before
    assert still_alive.grad_fn is not None


def test_per_primitive_state_is_sliced_and_other_state_is_unchanged() -> None:
    params, optimizers = field()
    other = torch.rand(5)
    state: dict[str, Any] = {
        "grad2d": torch.arange(20),
        "pair": torch.rand(20, 2),
        "other": other,
        "step": 20,
        "no": None,
    }
    scalar = state["scalar"] = torch.tensor(20)
    alone = {"grad2d": torch.arange(20, 0, -1), "other": other}
    network = [p.detach().clone() for p in optimizers["compensation"].param_groups[0]["params"]]
    keep(params, optimizers, [state, alone], some())
    assert state["grad2d"].tolist() == [0, 3, 6, 9, 12, 15, 18]
    assert state["pair"].shape == (7, 2)
    assert state["other"] is other
    assert state["scalar"] is scalar
    assert (state["step"], state["no"]) == (20, None)
    for value, before in zip(optimizers["compensation"].param_groups[0]["params"], network, strict=True):
        assert torch.equal(value, before)
    assert alone["grad2d"].tolist() == [20, 17, 14, 11, 8, 5, 2]
    assert alone["other"] is other


def test_a_one_element_step_of_one_primitive_is_not_sliced() -> None:
    params, optimizers = field(1)
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
    params, optimizers = field()
    with pytest.raises(DataError, match=message):
        keep(params, optimizers, [], mask)


@pytest.mark.parametrize("fault", ["length", "stale", "two groups"])
def test_nothing_changes_on_error(fault: str) -> None:
    params, optimizers = field()
    train(params, optimizers)
    if fault == "length":
        params["features"] = Parameter(torch.zeros(19, 13))
        del optimizers["features"]
    elif fault == "stale":
        optimizers["features"] = torch.optim.Adam([Parameter(torch.zeros(20, 13))])
    else:
        optimizers["features"].add_param_group({"params": [Parameter(torch.zeros(3))]})
    objects = dict(params)
    state: dict[str, Any] = {"grad2d": torch.arange(20)}
    with pytest.raises(DataError, match="'features'"):
        keep(params, optimizers, [state], some())
    with pytest.raises(DataError, match="'features'"):
        check_wiring(params, optimizers)
    assert all(params[name] is objects[name] for name in objects)
    assert optimizers["means"].param_groups[0]["params"][0] is params["means"]
    assert optimizers["means"].state[params["means"]]["exp_avg"].shape == (20, 3)
    assert state["grad2d"].shape == (20,)


def test_works_on_a_parameter_dict() -> None:
    params, optimizers = field()
    container = torch.nn.ParameterDict(params)
    keep(container, optimizers, [], some())
    assert {name: tuple(value.shape) for name, value in container.items()} == {n: (7, *s) for n, s in SHAPES.items()}
    assert len(list(container.parameters())) == len(SHAPES)


@pytest.mark.gpu
def test_a_mask_on_the_cpu_prunes_a_field_on_the_gpu() -> None:
    params = {name: Parameter(value.detach().cuda()) for name, value in field()[0].items()}
    optimizers: dict[str, torch.optim.Optimizer] = {name: torch.optim.Adam([value]) for name, value in params.items()}
    train(params, optimizers)
    keep(params, optimizers, [], some())
    train(params, optimizers)
    assert params["means"].is_cuda
    assert len(params["means"]) == 7
