"""The engine of trials by itself: several lengths, several fields to go back to, and a state that is resumed."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.optim import SGD, Adam
from torch.optim.lr_scheduler import LambdaLR

from sundae_ns.errors import CheckpointError
from sundae_ns.training.heldout import HeldOutQuality
from sundae_ns.training.schedulers import Decay
from sundae_ns.training.trials import engine
from sundae_ns.training.trials.engine import Trial, TrialEngine

VIEW = HeldOutQuality(10, 20.0, 0.5)


class FakeRun:
    """A run whose steps add 1 to every centre."""

    def __init__(self, state: Any) -> None:
        self.state = state
        self.held_out: list[int] = []
        self.source = SimpleNamespace(total=20)

    def hold_out(self, indices: Any) -> None:
        self.held_out = list(indices)

    def train(self, trials: TrialEngine, most: int = 100) -> int:
        """Train to the end of the trial, or ``most`` steps; returns their number."""
        for number in range(1, most + 1):
            self.state.step += 1
            self.state.field["means"].data += 1
            if trials.after_step(self):  # type: ignore[arg-type]
                return number
        return most


@pytest.fixture
def run(build: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> FakeRun:
    monkeypatch.setattr(engine, "AVERAGED_EVERY", 1)
    state = build(n=20).state
    state.head_starts_at = math.inf
    state.field["means"].data.zero_()
    state.optimizers = {name: Adam([value]) for name, value in state.field.items()}
    state.optimizers["compensation"] = Adam(state.head.parameters())
    return FakeRun(state)


def height(run: FakeRun) -> float:
    return float(run.state.field["means"].detach()[0, 0])


def test_trials_of_several_lengths_go_back_to_any_kept_field(run: FakeRun) -> None:
    decay = Decay(0.1, 1000, 1.0, False, 0)
    decay.pruned_at = 0
    run.state.schedulers = {"means": LambdaLR(SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0), lr_lambda=decay)}
    trials, state = TrialEngine(), run.state

    def age() -> int:
        """Steps since the rate has restarted, as far as they count."""
        return state.step - (decay.pruned_at or 0)

    trials.keep("first", state, head=False)
    trials.start(run, Trial(5, held_out=[2]))  # type: ignore[arg-type]
    assert run.held_out == [2]
    assert run.train(trials) == 5
    trials.keep("second", state, head=False)
    trials.start(run, Trial(3, held_out=[4]))  # type: ignore[arg-type]
    assert (run.train(trials), run.held_out, height(run)) == (3, [4], 8.0)
    trials.go_back("second", state)
    assert (height(run), trials.taken_back, age()) == (5.0, 3, 5)
    trials.start(run, Trial(4))  # type: ignore[arg-type]
    run.train(trials, most=2)
    trials.go_back("first", state)
    assert (height(run), trials.taken_back, age()) == (0.0, 3 + 2 + 5, 0)
    trials.go_back("second", state)  # its five steps count again
    assert (height(run), trials.taken_back, age()) == (5.0, 5, 5)
    trials.end(run, "count")  # type: ignore[arg-type]
    assert (run.held_out, trials.trial, trials.kept) == ([], None, {})


@pytest.mark.parametrize(("averaged", "shown", "own"), [(3, 4.0, 5.0), (0, 5.0, 5.0)])
def test_the_mean_of_the_last_weights_is_measured(
    run: FakeRun, monkeypatch: pytest.MonkeyPatch, averaged: int, shown: float, own: float
) -> None:
    seen: list[float] = []

    def measured(run: FakeRun, **_: bool) -> list[HeldOutQuality]:
        seen.append(height(run))
        return [VIEW]

    monkeypatch.setattr(engine, "measure_heldout", measured)
    trials = TrialEngine()
    trials.start(run, Trial(5, averaged=averaged))  # type: ignore[arg-type]
    run.train(trials)
    assert trials.measure(run) == [VIEW]  # type: ignore[arg-type]
    assert (seen, height(run)) == ([shown], own)


def test_a_field_is_provisional_until_the_trials_end(run: FakeRun) -> None:
    state, trials = run.state, TrialEngine(head_starts_at=2)
    trials.start(run, Trial(5, num_features=5, counts=False))  # type: ignore[arg-type]
    run.train(trials)
    assert state.head_enabled
    assert state.provisional
    trials.end(run, "count")  # type: ignore[arg-type]
    assert not state.provisional
    assert state.schedule_step - state.head_starts_at - trials.taken_back == 3


def test_another_width_begins_with_a_fresh_head_and_a_kept_one_comes_back(run: FakeRun) -> None:
    state, trials = run.state, TrialEngine()
    weights = {name: value.clone() for name, value in state.head.named_parameters()}
    trials.keep("start", state, head=True)
    trials.start(run, Trial(2, num_features=29))  # type: ignore[arg-type]
    assert (state.head.config.num_features, state.field["features"].shape) == (29, (20, 29))
    trials.go_back("start", state)
    trials.start(run, Trial(2, num_features=0))  # type: ignore[arg-type]
    assert not state.head_enabled
    assert (state.head.config.num_features, state.field["features"].shape) == (5, (20, 5))
    assert all(torch.equal(value, weights[name]) for name, value in state.head.named_parameters())


def test_a_state_in_the_middle_of_a_trial_is_resumed(run: FakeRun) -> None:
    trials, other, state = TrialEngine(), TrialEngine(), run.state
    trials.keep("first", state, head=False)
    trials.start(run, Trial(6, held_out=[1, 3], averaged=5, counts=False))  # type: ignore[arg-type]
    run.train(trials, most=4)
    saved = copy.deepcopy(trials.state_dict())
    state.provisional = False
    other.load_state_dict(state, saved)
    other.require("first")
    assert state.provisional
    run.held_out = []
    other.resume(run)  # type: ignore[arg-type]
    assert run.held_out == [1, 3]
    assert run.train(other) == 2
    other.take_mean(state)
    assert height(run) == 4.0  # of the steps 2 to 6
    other.go_back("first", state)
    assert (height(run), other.taken_back) == (0.0, 6)


@pytest.mark.parametrize("saved", [{}, {"kept": {"first": {}}}, {"trial": {"length": 3}}])
def test_a_state_without_a_field_to_go_back_to_is_refused(run: FakeRun, saved: dict[str, Any]) -> None:
    trials = TrialEngine()
    trials.load_state_dict(run.state, saved)
    with pytest.raises(CheckpointError, match="lacks a field") as raised:
        trials.require("first")
    assert "\n" not in str(raised.value)
