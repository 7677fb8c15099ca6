"""Dropout with few views: its share, its expectation, and where it does not act."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from sundae_ns.errors import ConfigError
from sundae_ns.model import SundaeModel
from sundae_ns.rendering import render
from sundae_ns.rendering.render import left_out

Build = Callable[..., SundaeModel]
LENGTH = 40


def dropping(build: Build, training_of: Callable[..., Any], **options: Any) -> Any:
    """A training of few views whose schedule has 40 steps."""
    team = SimpleNamespace(collective=False)
    config = SimpleNamespace(schedule_length=LENGTH, load_dir=None, load_checkpoint=None)
    trainer = SimpleNamespace(last_step=LENGTH - 1, config=config, team=team, base_dir=None)
    return training_of(build(**{"dropout_views": 24, "pruning": {"mode": "off"}, **options}), trainer)


def test_a_share_is_left_out_and_the_expectation_stays() -> None:
    """Within five standard deviations of the mean of 20,000 draws each."""
    torch.manual_seed(3)
    opacities = torch.tensor([0.05, 0.3, 0.75]).repeat_interleave(20_000).requires_grad_()
    found = left_out(opacities, 0.25)
    for value, one in zip((0.05, 0.3, 0.75), found.detach().split(20_000), strict=True):
        assert float((one == 0).float().mean()) == pytest.approx(0.25, abs=5 * (0.25 * 0.75 / 20_000) ** 0.5)
        assert float(one.mean()) == pytest.approx(value, abs=5 * value * (1 / 3 / 20_000) ** 0.5)
        assert float(one.max()) == pytest.approx(value / 0.75)
    (grad,) = torch.autograd.grad(found.sum(), opacities)
    assert torch.equal(grad == 0, found == 0) or float((found == 1).float().mean()) > 0
    assert float(left_out(torch.ones(1000), 0.5).max()) == 1.0
    assert left_out(opacities, 0.0) is opacities


def test_the_share_rises_over_the_schedule(build: Build, training_of: Callable[..., Any]) -> None:
    state = dropping(build, training_of).model.state
    found = []
    for state.step in (0, 1, 10, 20, 39, 40, 100):
        found.append(state.dropped)
    assert found == pytest.approx([0.0, 0.0, 0.05, 0.1, 0.19, 0.2, 0.2])


def test_training_images_leave_out_primitives_and_others_do_not(
    build: Build, training_of: Callable[..., Any], camera: Callable[..., Any]
) -> None:
    model = dropping(build, training_of, background_color="black", head={"mode": "off"}, stop_split_at=5).model
    model.step = 30
    assert model.render_settings(training=True).dropped == pytest.approx(0.15)
    shown = model.eval().get_outputs_for_camera(camera())["rgb"].clone()
    model.train()
    images = []
    for seed in (1, 2, 1):
        torch.manual_seed(seed)
        images.append(model.get_outputs(camera())["rgb"])
    assert not torch.equal(images[0], images[1])
    assert torch.equal(images[0], images[2])
    dropout, model.state.dropout = model.state.dropout, None
    assert dropout is not None
    whole = model.get_outputs(camera())["rgb"]
    assert torch.equal(shown, model.eval().get_outputs_for_camera(camera())["rgb"])
    assert not torch.equal(images[0], whole)


@pytest.mark.parametrize("options", [{"dropout_views": 3}, {"dropout_views": 0}])
def test_other_runs_have_none(
    build: Build, training_of: Callable[..., Any], options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    training = dropping(build, training_of, **options)
    monkeypatch.setattr(torch, "rand_like", None)
    training.model.step = LENGTH
    assert training.model.render_settings(training=True).dropped == 0
    render.left_out(torch.ones(2), 0.0)


def test_without_a_trainer_there_is_none(build: Build, training_of: Callable[..., Any]) -> None:
    model = training_of(build(dropout_views=24)).model
    assert model.state.dropout is None


def test_a_negative_number_of_views_is_an_error(build: Build) -> None:
    with pytest.raises(ConfigError, match="dropout-views is -1; give a number of images, or 0"):
        build(dropout_views=-1)
