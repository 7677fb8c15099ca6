"""Floaters in front of cameras go once the field has stopped growing, and only then."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from sundae_ns.plugin.model import SundaeModel

Build = Callable[..., SundaeModel]
TrainingOf = Callable[..., Any]
FLOATERS = [4, 50]
"""Rows of a field of 60 Gaussians; the cameras are 3 away from its middle."""


def with_floaters(build: Build, **options: Any) -> SundaeModel:
    model = build(pruning={"keep_ratio": 1.0, "prune_at": 4}, stop_split_at=4, **options)
    with torch.no_grad():
        model.gauss_params["means"][FLOATERS] = torch.tensor([0.5, 0.1, 2.9])  # a tenth in front of the third camera
    return model


def near(model: SundaeModel) -> int:
    return int((model.means[:, 2] > 2).sum())


def test_floaters_go_when_growth_ends_and_training_goes_on(
    build: Build, training_of: TrainingOf, capsys: pytest.CaptureFixture[str]
) -> None:
    training = training_of(with_floaters(build))
    for step in range(3):
        training.step(step)
        assert near(training.model) == 2
    training.step(3)
    assert training.model.num_points == 58
    assert near(training.model) == 0
    assert "removed 2 floaters right in front of a camera" in " ".join(capsys.readouterr().out.split())
    assert training.live()
    training.step(4)
    assert training.model.num_points == 58


def test_a_capture_without_points_keeps_its_field(build: Build, training_of: TrainingOf) -> None:
    training = training_of(with_floaters(build, seed_points=None, num_random=60))
    for step in range(5):
        training.step(step)
    assert training.model.num_points == 60


@pytest.mark.parametrize(("saved_after", "left"), [(2, 0), (3, 1)])
def test_a_resumed_run_removes_them_only_if_that_was_still_due(
    build: Build, training_of: TrainingOf, saved_after: int, left: int
) -> None:
    training = training_of(with_floaters(build))
    for step in range(saved_after + 1):
        training.step(step)
    saved = training.model.state_dict()
    model = build(pruning={"keep_ratio": 1.0, "prune_at": 4}, stop_split_at=4)
    model.load_state_dict(saved)
    with torch.no_grad():  # moved there since, as in a field that trains on
        model.gauss_params["means"][0] = torch.tensor([0.5, 0.1, 2.9])
    resumed = training_of(model)
    resumed.step(saved_after + 1)
    assert near(resumed.model) == left


def test_a_run_that_was_pruned_by_an_earlier_version_is_done(build: Build, training_of: TrainingOf) -> None:
    model = with_floaters(build)
    callback = {one.name: one for one in model.train_callbacks}["floaters"]
    callback.load_state_dict(model.state, {})
    assert callback.state_dict() == {"done": False}
    model.state.pruning["num_prunes"] = 1
    callback.load_state_dict(model.state, {})
    assert callback.state_dict() == {"done": True}
