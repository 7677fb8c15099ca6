"""Learning rates: the decay, its restart at the prune, and a state that plain ``torch.load`` reads."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.optim import Adam
from torch.optim.lr_scheduler import ExponentialLR, LambdaLR

from sundae_ns.plugin.optimizer_configs import NetworkAdamConfig, PruneAwareDecayConfig
from sundae_ns.train.schedules import MOST_FACTOR, SPARSE, Decay, limit_rise, notify_pruned, put_restarts, restarts


def scheduler(**options: object) -> LambdaLR:
    config = PruneAwareDecayConfig(lr_final=1e-4, max_steps=100, **options)  # type: ignore[arg-type]
    optimizer = Adam([torch.nn.Parameter(torch.zeros(1))], lr=1e-2)
    made = config.setup().get_scheduler(optimizer, lr_init=1e-2)
    assert isinstance(made, LambdaLR)
    return made


def rates(
    made: LambdaLR, steps: int, prune_at: int | None = None, *, name: str = "means", primitives: int = SPARSE
) -> list[float]:
    """Rate that each step uses, the scheduler stepping after it as in nerfstudio's trainer."""
    found = []
    for step in range(steps):
        found.append(made.optimizer.param_groups[0]["lr"])
        made.optimizer.step()
        made.step()
        if step == prune_at:
            notify_pruned({name: made}, step, primitives)
    return found


def test_exponential_from_first_to_last() -> None:
    found = rates(scheduler(), 130)
    assert found[0] == pytest.approx(1e-2)
    assert found[50] == pytest.approx(1e-3)
    assert found[100] == pytest.approx(1e-4)
    assert found[129] == pytest.approx(1e-4)


def test_half_a_cosine_from_first_to_last() -> None:
    found = rates(scheduler(shape="cosine"), 130)
    assert found[0] == pytest.approx(1e-2)
    assert found[25] == pytest.approx(1e-4 + 0.99e-2 * (1 + 0.5**0.5) / 2)
    assert found[50] == pytest.approx((1e-2 + 1e-4) / 2)
    assert found[100] == found[129] == pytest.approx(1e-4)
    restarted = rates(scheduler(shape="cosine", lr_restart=4e-3, warmup_steps=4), 130, prune_at=40)
    assert restarted[:41] == pytest.approx(found[:41])
    assert restarted[42] == pytest.approx(3 / 5 * 4e-3, rel=0.01)
    assert restarted[70] == pytest.approx((4e-3 + 1e-4) / 2)
    assert restarted[100] == pytest.approx(1e-4)


def test_prune_restarts_the_decay() -> None:
    found = rates(scheduler(lr_restart=4e-3), 130, prune_at=40)
    plain = rates(scheduler(), 130)
    assert found[:41] == pytest.approx(plain[:41])
    assert found[41] == pytest.approx(4e-3, rel=0.1)
    assert found[70] == pytest.approx((4e-3 * 1e-4) ** 0.5)
    assert found[100] == pytest.approx(1e-4)


@pytest.mark.parametrize(
    ("primitives", "factor"), [(10 * SPARSE, 1), (SPARSE, 1), (SPARSE // 4, 2), (SPARSE // 9, 3), (1, MOST_FACTOR)]
)
def test_centres_of_few_primitives_move_faster_after_the_prune(primitives: int, factor: float) -> None:
    usual = rates(scheduler(lr_restart=4e-3), 130, prune_at=40)
    found = rates(scheduler(lr_restart=4e-3), 130, prune_at=40, primitives=primitives)
    assert found[:41] == usual[:41]
    assert found[41:] == pytest.approx([factor * rate for rate in usual[41:]], rel=1e-3)
    head = rates(scheduler(lr_restart=4e-3), 130, prune_at=40, name="compensation", primitives=primitives)
    assert head == usual
    never = rates(scheduler(), 130, prune_at=40, primitives=primitives)
    assert never == rates(scheduler(), 130)


def test_held_until_the_prune_then_rising_and_falling() -> None:
    found = rates(scheduler(lr_restart=1e-2, hold_until_prune=True, warmup_steps=9), 130, prune_at=40)
    assert found[:41] == pytest.approx([1e-2] * 41)
    assert found[41] == pytest.approx(2 / 10 * 1e-2, rel=0.1)
    rising = found[41:50]
    assert rising == sorted(rising)
    assert found[49] > 0.5e-2
    falling = found[52:101]
    assert falling == sorted(falling, reverse=True)
    assert found[100] == pytest.approx(1e-4)


def test_only_the_first_prune_counts_and_others_are_left_alone() -> None:
    made = scheduler(lr_restart=1e-2)
    stock = ExponentialLR(Adam([torch.nn.Parameter(torch.zeros(1))]), gamma=0.9)
    notify_pruned({"means": made, "other": stock}, 10, SPARSE)
    notify_pruned({"means": made, "other": stock}, 20, SPARSE)
    (decay,) = made.lr_lambdas
    assert isinstance(decay, Decay)
    assert decay.pruned_at == 10


def head_scheduler() -> LambdaLR:
    """Of a network with weights, which decay, and biases: two groups, and torch lists a multiplier for each."""
    optimizer = NetworkAdamConfig(lr=1e-2, weight_decay=0.1).setup(
        [torch.nn.Parameter(torch.zeros(2, 2)), torch.zeros(1)]
    )
    config = PruneAwareDecayConfig(
        lr_final=1e-4, max_steps=100, lr_restart=1e-2, hold_until_prune=True, warmup_steps=9, shape="cosine"
    )
    made = config.setup().get_scheduler(optimizer, lr_init=1e-2)
    assert isinstance(made, LambdaLR)
    assert len(made.lr_lambdas) == 2
    return made


def test_a_trial_that_starts_again_has_the_rates_of_the_first() -> None:
    made, trials = head_scheduler(), []
    untouched = restarts({"compensation": made})
    notify_pruned({"compensation": made}, 0, SPARSE)
    began = restarts({"compensation": made})
    for _ in range(3):
        trials.append([])
        for _ in range(12):
            trials[-1].append([group["lr"] for group in made.optimizer.param_groups])
            made.optimizer.step()
            made.step()
        put_restarts({"compensation": made}, began, 12 * len(trials))
    first, *others = ([weights for weights, _ in trial] for trial in trials)
    assert all(weights == biases for trial in trials for weights, biases in trial)
    assert first[0] == pytest.approx(1 / 10 * 1e-2)
    assert first[:10] == sorted(first[:10])
    for other in others:
        assert other[0] == pytest.approx(first[0])
        # The decay has less time left.
        assert other == pytest.approx(first, rel=0.06)
    # A field that was not pruned yet has the rates of before the prune again.
    put_restarts({"compensation": made}, untouched, 0)
    assert made.optimizer.param_groups[0]["lr"] == 1e-2


def test_the_rates_of_a_trial_decay_as_those_of_a_run() -> None:
    decay = Decay(0.01, 1000, 1.0, False, 0, pruned_at=100, ends_at=200)
    assert [decay(step) for step in (100, 150, 200, 500)] == pytest.approx([1, 0.1, 0.01, 0.01])
    assert replace(decay, ends_at=None)(1000) == pytest.approx(0.01)
    assert replace(decay, ends_at=None)(200) > 0.5


def test_the_rise_of_a_rate_is_limited_before_it_begins() -> None:
    made = head_scheduler()
    limit_rise({"compensation": made}, 20)
    limit_rise({"compensation": made}, 4)
    notify_pruned({"compensation": made}, 0, SPARSE)
    limit_rise({"compensation": made}, 1)
    assert made.optimizer.param_groups[0]["lr"] == pytest.approx(1 / 5 * 1e-2)
    assert {decay.warmup_steps for decay in made.lr_lambdas} == {4}


def test_rates_are_python_floats() -> None:
    made = scheduler(lr_restart=1e-3)
    for step in (0, 7, 200):
        assert type(made.lr_lambdas[0](step)) is float  # type: ignore[operator]
    rates(made, 5, prune_at=2)
    assert all(type(rate) is float for rate in made.get_last_lr())
