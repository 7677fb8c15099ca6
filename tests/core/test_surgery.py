"""Surgery on a field in training: removal, copies, snapshots; complete, and without effect on error."""

import pytest
import torch
from fields import normal_field
from hypothesis import given
from hypothesis import strategies as st
from prunes import train
from torch import nn
from torch.nn import Parameter
from torch.optim import Adam

from sundae_ns.core.errors import DataError
from sundae_ns.core.surgery import check_wiring, grow, keep, module_snapshot, restore, restore_module, rewrite, snapshot

FIELD = normal_field(20, features=13)
TRAINED = sorted(FIELD.keys() - {"quats"})
SOME = torch.arange(20) % 3 == 0


def gaussians(n=20):
    """A field with frozen rotations, and its optimizers; one of them is that of a network."""
    params = {name: Parameter(value) for name, value in normal_field(n, features=13).items()}
    params["quats"].requires_grad_(False)
    optimizers = {name: Adam([{"params": params[name], "lr": 0.1}], eps=1e-15) for name in TRAINED}
    return params, {**optimizers, "compensation": Adam(nn.Linear(n, n).parameters())}


def moments(optimizers, params, name):
    return optimizers[name].state[params[name]]["exp_avg"]


def test_training_continues_as_if_only_the_kept_primitives_had_existed():
    (params, optimizers), (expected, expected_optimizers) = gaussians(), gaussians()
    params = nn.ParameterDict(params)
    still_alive = params["means"].exp().sum()
    keep(expected, expected_optimizers, [], SOME)
    for held, holders in ((params, optimizers), (expected, expected_optimizers)):
        train(held, holders, 3)
    keep(params, optimizers, [], SOME)
    for held, holders in ((params, optimizers), (expected, expected_optimizers)):
        train(held, holders, 3)
    for name, value in params.items():
        assert value.shape == (7, *FIELD[name].shape[1:])
        torch.testing.assert_close(value, expected[name])
        assert value.requires_grad == (name in TRAINED)
    assert all(list(optimizers[name].state) == [params[name]] for name in TRAINED)
    assert still_alive.grad_fn is not None  # a live graph of an earlier step does not break training


def test_per_primitive_state_is_sliced_and_other_state_is_unchanged():
    params, optimizers = gaussians()
    rest = {"other": torch.rand(5), "step": 20, "no": None, "scalar": torch.tensor(20)}
    state, alone = {"grad2d": torch.arange(20), **rest}, {"pair": torch.rand(20, 2), **rest}
    network = [p.detach().clone() for p in optimizers["compensation"].param_groups[0]["params"]]
    keep(params, optimizers, [state, alone], SOME)
    assert state["grad2d"].tolist() == [0, 3, 6, 9, 12, 15, 18]
    assert alone["pair"].shape == (7, 2)
    assert all(each[name] is value for each in (state, alone) for name, value in rest.items())
    for value, before in zip(optimizers["compensation"].param_groups[0]["params"], network, strict=True):
        assert torch.equal(value, before)


def test_a_one_element_step_of_one_primitive_is_not_sliced():
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
def test_wrong_masks_are_refused(mask, message):
    with pytest.raises(DataError, match=message):
        keep(*gaussians(), [], mask)


FAULTS = {
    "length": lambda params, _: params.update(features=Parameter(torch.zeros(19, 13))),
    "stale": lambda _, optimizers: optimizers.update(features=Adam([Parameter(torch.zeros(20, 13))])),
    "two groups": lambda _, optimizers: optimizers["features"].add_param_group({"params": [Parameter(torch.ones(3))]}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_nothing_changes_on_error(fault):
    params, optimizers = gaussians()
    train(params, optimizers)
    FAULTS[fault](params, optimizers)
    objects, state = dict(params), {"grad2d": torch.arange(20)}
    with pytest.raises(DataError, match="'features'"):
        keep(params, optimizers, [state], SOME)
    with pytest.raises(DataError, match="'features'"):
        check_wiring(params, optimizers)
    assert all(params[name] is objects[name] for name in objects)
    assert optimizers["means"].state[params["means"]]["exp_avg"].shape == (20, 3)
    assert state["grad2d"].shape == (20,)


@pytest.mark.gpu
def test_a_mask_on_the_cpu_prunes_a_field_on_the_gpu():
    params = {name: Parameter(value.detach().cuda()) for name, value in gaussians()[0].items()}
    optimizers = {name: Adam([value]) for name, value in params.items()}
    train(params, optimizers)
    keep(params, optimizers, [], SOME)
    train(params, optimizers)
    assert params["means"].is_cuda
    assert len(params["means"]) == 7


def test_training_continues_from_a_snapshot_bit_for_bit():
    params, optimizers = gaussians()
    train(params, optimizers, 3)
    saved = snapshot(params, optimizers)
    train(params, optimizers, 4)
    expected = {name: value.detach().clone() for name, value in params.items()}
    keep(params, optimizers, [], torch.arange(20) < 7)
    train(params, optimizers, 5)
    for _ in range(2):  # a snapshot can be restored more than once
        restore(params, optimizers, saved)
        for name in TRAINED:
            assert optimizers[name].param_groups[0]["params"] == [params[name]]
            assert list(optimizers[name].state) == [params[name]]
        train(params, optimizers, 4)
        assert all(torch.equal(value, expected[name]) for name, value in params.items())


def test_a_snapshot_before_the_first_step_has_no_moments():
    params, optimizers = gaussians()
    saved = snapshot(params, optimizers)
    train(params, optimizers)
    del optimizers["means"]
    restore(params, optimizers, saved)
    assert not any(optimizer.state for name, optimizer in optimizers.items() if name in TRAINED)
    train(params, optimizers)


def test_a_network_is_restored_in_place():
    net = nn.Sequential(nn.Linear(3, 4), nn.Linear(4, 1))
    optimizer = Adam(net.parameters())

    def steps(count):
        for _ in range(count):
            optimizer.zero_grad()
            net(torch.ones(2, 3)).square().sum().backward()
            optimizer.step()

    fresh = module_snapshot(optimizer)
    steps(3)
    saved, objects = module_snapshot(optimizer), list(net.parameters())
    steps(4)
    expected = [value.detach().clone() for value in net.parameters()]
    steps(2)
    restore_module(optimizer, saved)
    assert all(a is b for a, b in zip(objects, net.parameters()))
    steps(4)
    assert all(torch.equal(a, b) for a, b in zip(expected, net.parameters()))
    restore_module(optimizer, fresh)
    assert not optimizer.state, "before the first step there are no moments"


def integral(opacity, scale, copies):
    """Integral along a line of the opacity of ``copies`` Gaussians at one place, by the midpoint rule."""
    x = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 20_000 * 24 - 12
    alpha = opacity * torch.exp(-0.5 * (x / scale) ** 2)
    return float((1 - (1 - alpha) ** copies).sum() * 24 / 20_000)


@given(st.floats(0.02, 0.99))
def test_copies_render_like_the_original(opacity):
    params = {name: Parameter(torch.zeros(1, 3).double()) for name in ("means", "scales")}
    params["opacities"] = Parameter(torch.logit(torch.tensor([[opacity]], dtype=torch.float64)))
    grow(params, {}, 1, 0.005)
    new, scale = params["opacities"].detach().sigmoid()[:, 0], params["scales"].detach().exp()
    assert new[0] == new[1]
    assert torch.equal(scale[0], scale[1])
    assert 1 - (1 - float(new[0])) ** 2 == pytest.approx(opacity, rel=1e-9)
    assert integral(float(new[0]), float(scale[0, 0]), 2) == pytest.approx(integral(opacity, 1.0, 1), rel=1e-6)


@pytest.mark.parametrize("count", [0, 7, 30, 95])
def test_growing_adds_the_exact_number_upon_the_most_opaque(count):
    params, optimizers = gaussians(30)
    train(params, optimizers)
    params["opacities"].data[7:9] = torch.tensor([[40.0], [-110.0]])  # 1 in float32, whose logit is infinite, and 0
    old, before = params["means"].detach().clone(), moments(optimizers, params, "features").clone()
    opaque = params["opacities"].detach().flatten().argsort(descending=True)
    grow(params, optimizers, count, 0.005)
    assert {len(value) for value in params.values()} == {30 + count}
    assert all(value.isfinite().all() for value in params.values())
    for name in TRAINED:
        assert optimizers[name].param_groups[0]["params"] == [params[name]]
        assert moments(optimizers, params, name).shape == params[name].shape
    assert torch.equal(params["means"][:30], old)
    assert torch.equal(params["means"][30:60], old[opaque[: min(count, 30)]])
    assert torch.equal(moments(optimizers, params, "features")[:30], before)
    assert not moments(optimizers, params, "features")[30:].any()


@pytest.mark.parametrize("steps", [0, 1])
def test_rewriting_resets_first_moments_of_changed_values_only(steps):
    params, optimizers = gaussians()
    train(params, optimizers, steps)
    before = {name: value.detach().clone() for name, value in params.items()}
    values = {name: value.clone() for name, value in before.items()}
    values["means"][2] += 1
    values["opacities"][4] += 1
    values["quats"] += 1  # which no optimizer holds
    objects, saved = dict(params), snapshot(params, optimizers)
    rewrite(params, optimizers, values)
    assert all(params[name] is objects[name] and torch.equal(params[name].data, values[name]) for name in params)
    for name in TRAINED:
        assert len(optimizers[name].state) == steps
        for state in optimizers[name].state.values():
            old, changed = saved[name], values[name] != before[name]
            assert not state["exp_avg"][changed].any()
            assert torch.equal(state["exp_avg"][~changed], old["exp_avg"][~changed])
            assert torch.equal(state["exp_avg_sq"], old["exp_avg_sq"])


def test_rewriting_refuses_wrong_names_and_shapes_and_changes_nothing():
    params, optimizers = gaussians()
    before = params["means"].detach().clone()
    for values in ({"means": before + 1, "colour": before}, {"means": before + 1, "scales": before[:2]}):
        with pytest.raises(DataError, match="one row per Gaussian"):
            rewrite(params, optimizers, values)
    assert torch.equal(params["means"].detach(), before)
