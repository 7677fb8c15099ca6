"""A model's state, saved and loaded: into another count, and refused where it does not fit."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch

from sundae_ns.core.errors import CheckpointError
from sundae_ns.plugin.model import SundaeModel

Build = Callable[..., SundaeModel]
TrainingOf = Callable[[SundaeModel], Any]


def saved(model: SundaeModel, path: Path) -> dict[str, Any]:
    torch.save(model.state_dict(), path)
    return torch.load(path, weights_only=True)


def test_round_trip_into_another_count_keeps_optimizers_alive(
    build: Build, training_of: TrainingOf, tmp_path: Path
) -> None:
    source = training_of(build())
    for step in range(5):
        source.step(step)
    state = saved(source.model, tmp_path / "a.pt")
    assert source.model.num_points == 30

    target = training_of(build(n=25))
    held = dict(target.model.gauss_params.items())
    target.model.load_state_dict(state)
    for name, value in target.model.gauss_params.items():
        assert value is held[name]
        assert torch.equal(value, source.model.gauss_params[name])
    assert target.model.step == 4
    assert target.model.state.pruning == source.model.state.pruning
    assert target.model.state.head_enabled
    for (_, ours), (_, theirs) in zip(
        target.model.head.named_parameters(),  # type: ignore[union-attr]
        source.model.head.named_parameters(),  # type: ignore[union-attr]
        strict=True,
    ):
        assert torch.equal(ours, theirs)
    target.optimizers.load_optimizers(deepcopy({k: v.state_dict() for k, v in source.optimizers.optimizers.items()}))
    assert target.live()
    torch.manual_seed(5)
    expected = source.step(5)
    torch.manual_seed(5)
    found = target.step(5)
    assert target.model.num_points == 30
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value)
    for name, value in target.model.gauss_params.items():
        torch.testing.assert_close(value, source.model.gauss_params[name])


def test_state_of_densification_is_kept(build: Build, training_of: TrainingOf, tmp_path: Path) -> None:
    source = training_of(build())
    source.step(0)
    assert source.model.state.densification["grad2d"].any()
    target = build(n=25)
    target.load_state_dict(saved(source.model, tmp_path / "a.pt"))
    assert torch.equal(target.state.densification["grad2d"], source.model.state.densification["grad2d"])
    assert target.state.densification["scene_scale"] == source.model.state.densification["scene_scale"]


def _stock(state: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in state.items() if k.startswith("gauss_params.") and not k.endswith(".features")}


@pytest.mark.parametrize(
    ("options", "change", "cause"),
    [
        ({}, _stock, "splatfacto checkpoint.*warm-start"),
        ({"head": {"num_features": 1}}, None, "length 1"),
        ({"head": {"mode": "off"}}, None, "length 0"),
        ({"head": {"size": "compact"}}, None, "head"),
        ({"head": {"mode": "features"}}, None, "head"),
        ({"sh_degree": 2}, None, "features_rest"),
    ],
)
def test_other_checkpoints_are_refused_and_nothing_changes(
    build: Build, options: dict[str, Any], change: Callable[[dict[str, Any]], dict[str, Any]] | None, cause: str
) -> None:
    state = build(n=25, **options).state_dict()
    model = build()
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    with pytest.raises(CheckpointError, match=cause) as caught:
        model.load_state_dict(change(state) if change else state)
    assert isinstance(caught.value, ValueError)
    assert "\n" not in str(caught.value)
    assert all(torch.equal(value, before[name]) for name, value in model.named_parameters())
