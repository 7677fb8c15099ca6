"""Prunes between steps of training: the count, the optimizers, and that training goes on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation

from sundae_ns.plugin.model import SundaeModel
from sundae_ns.train.initialize import Start
from sundae_ns.train.schedules import Decay

Build = Callable[..., SundaeModel]
TrainingOf = Callable[..., Any]

N = 60
"""Gaussians of a model that is built without a count."""


def trainer_of(folder: Path | None = None) -> SimpleNamespace:
    """What a run of three steps asks of its trainer."""
    config = SimpleNamespace(schedule_length=None, load_dir=None, load_checkpoint=None)
    return SimpleNamespace(last_step=2, base_dir=folder, config=config)


@pytest.mark.parametrize("score", ["detail-contribution", "response"])
def test_prune_keeps_the_count_and_training_goes_on(
    build: Build, training_of: TrainingOf, score: str, capsys: pytest.CaptureFixture[str]
) -> None:
    training = training_of(build(pruning={"score": score}, background_color="black"))
    losses = [training.step(step) for step in range(3)]
    assert training.model.num_points == N
    training.step(3)
    assert training.model.num_points == N // 2
    assert training.live()
    assert "kept 30 of 60" in " ".join(capsys.readouterr().out.split())
    before = training.model.means.detach().clone()
    losses += [training.step(step) for step in range(4, 20)]
    assert training.model.num_points == N // 2
    assert training.live()
    assert (training.model.means.detach() - before).abs().max() > 0
    assert losses[-1]["main_loss"] < losses[3]["main_loss"] - 0.01
    assert "base_loss" in losses[-1]
    assert "base_loss" not in losses[0]


def test_primitives_that_are_not_finite_are_dropped_and_counted(
    build: Build, training_of: TrainingOf, capsys: pytest.CaptureFixture[str]
) -> None:
    training = training_of(build())
    training.step(0)
    training.step(1)
    with torch.no_grad():
        training.model.gauss_params["means"][[3, 5]] = torch.nan
        training.model.gauss_params["scales"][7, 1] = torch.inf
        training.model.gauss_params["features"][9, 0] = torch.nan
    # A step on a broken field would spread the damage; the prune itself is what is tested.
    training.act("pruning", 3)
    assert training.model.num_points == round(0.5 * (N - 4))
    assert all(torch.isfinite(value).all() for value in training.model.gauss_params.values())
    assert training.live()
    out = " ".join(capsys.readouterr().out.split())
    assert "removed 4 Gaussians that were not finite" in out
    assert training.step(4)["main_loss"].isfinite()


@pytest.mark.parametrize("options", [{"mode": "off"}, {"keep_ratio": 1.0}])
def test_nothing_goes_unless_asked_for(build: Build, training_of: TrainingOf, options: dict[str, Any]) -> None:
    training = training_of(build(pruning=options))
    for step in range(6):
        training.step(step)
    assert training.model.num_points == N


def test_the_rate_of_a_head_that_starts_later_begins_with_it(build: Build, training_of: TrainingOf) -> None:
    training = training_of(build(head={"start_at": 6}))
    decays = {name: Decay(0.01, 20, 1.0, name == "compensation", 0) for name in ("means", "compensation")}
    for name, decay in decays.items():
        optimizer = training.optimizers.optimizers[name]
        training.optimizers.schedulers[name] = torch.optim.lr_scheduler.LambdaLR(optimizer, decay)
    for step in range(8):
        training.step(step)
        assert training.model.state.head_enabled == (step > 6)
    assert {name: decay.pruned_at for name, decay in decays.items()} == {"means": 3, "compensation": 6}


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [line for line in capsys.readouterr().out.splitlines() if " needs more than " in line]


@pytest.mark.parametrize(
    ("pruning", "head", "ending"),
    [
        (
            {"prune_at": 3},
            {},
            "3 (pruning.prune-at): nothing is pruned, and the head stays disabled; train longer, or prune",
        ),
        ({"prune_at": 3}, {"mode": "off"}, "3 (pruning.prune-at): nothing is pruned; train longer, or prune earlier"),
        ({"prune_at": 3}, {"start_at": 1}, "3 (pruning.prune-at): nothing is pruned; train longer, or prune earlier"),
        ({"mode": "continuous", "start": 3}, {}, "3 (pruning.start): nothing is pruned, and the head stays disabled"),
        (
            {"mode": "continuous", "start": 1, "every": 3, "stop": 5},
            {},
            "4 (pruning.stop): more Gaussians are left than asked for, and the head stays disabled; train longer",
        ),
        (
            {"mode": "continuous", "start": 1, "every": 5, "stop": 5},
            {},
            "6 (pruning.stop): it stays disabled; train longer, or prune earlier",
        ),
        (
            {"mode": "continuous", "start": 1, "every": 5, "stop": 5, "max_gaussians": 40},
            {},
            "5 (pruning.stop): more Gaussians are left than asked for, and the head stays disabled; train longer",
        ),
        ({"prune_at": 1}, {"start_at": 4}, "5 (head.start-at): it stays disabled; train longer, or enable it earlier"),
        ({"prune_at": 1}, {"start_at": 2}, "3 (head.start-at): it stays disabled; train longer, or enable it earlier"),
        ({"mode": "off"}, {"start_at": 4}, "5 (head.start-at): it stays disabled; train longer, or enable it earlier"),
        ({"mode": "off"}, {}, "4 (pruning.prune-at): it stays disabled; train longer, or prune earlier"),
        ({"prune_at": 2}, {}, "3 (pruning.prune-at): it stays disabled; train longer, or prune earlier"),
        (
            {"prune_at": 3},
            {"start_at": 9},
            "3 (pruning.prune-at): nothing is pruned, and the head stays disabled; train",
        ),
    ],
)
def test_a_run_that_does_not_prune_to_the_end_says_so_in_one_line_before_and_after(
    build: Build,
    training_of: TrainingOf,
    capsys: pytest.CaptureFixture[str],
    pruning: dict[str, Any],
    head: dict[str, Any],
    ending: str,
    tmp_path: Path,
) -> None:
    training = training_of(build(pruning=pruning, head=head), trainer_of(tmp_path))
    (before,) = said(capsys)
    which = "first prune" if "nothing" in ending else "head" if "it stays" in ending else "last prune"
    assert before.startswith(f"Warning: training ends after 3 steps, and the {which} needs more than " + ending)
    for step in range(3):
        training.step(step)
    assert said(capsys) == []
    training.run_callbacks(TrainingCallbackLocation.AFTER_TRAIN, 2)
    assert said(capsys) == [before]


@pytest.mark.parametrize(
    "options",
    [
        {"pruning": {"prune_at": 1}},
        {"pruning": {"prune_at": 2}, "head": {"mode": "off"}},
        {"pruning": {"mode": "off"}, "head": {"mode": "off"}},
        {"pruning": {"mode": "off"}, "head": {"start_at": 1}},
        {"pruning": {"mode": "continuous", "start": 1, "stop": 1}},
        {"pruning": {"mode": "continuous", "start": 1, "every": 5, "stop": 5}, "head": {"mode": "off"}},
        {"pruning": {"prune_at": 100}, "warm_start": Path("anything")},
        {"pruning": {"prune_at": 100}, "head": {"start_at": 101}, "warm_start": Path("anything")},
    ],
)
def test_a_run_that_prunes_or_is_not_to_says_nothing(
    build: Build, training_of: TrainingOf, capsys: pytest.CaptureFixture[str], options: dict[str, Any]
) -> None:
    model = build(**options)
    model._start = Start()  # of a file that need not be there
    training = training_of(model, trainer_of())
    training.run_callbacks(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, 2)
    training.run_callbacks(TrainingCallbackLocation.AFTER_TRAIN, 2)
    assert said(capsys) == []


def test_a_warm_start_counts_from_the_prune(
    build: Build, training_of: TrainingOf, capsys: pytest.CaptureFixture[str]
) -> None:
    model = build(pruning={"prune_at": 100}, head={"start_at": 102}, warm_start=Path("anything"))
    model._start = Start()  # of a file that need not be there
    training_of(model, trainer_of())
    (line,) = said(capsys)
    assert "training ends after 3 steps, and the head needs more than 3 (head.start-at): it stays disabled" in line
