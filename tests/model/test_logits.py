"""A model without harmonics, whose first band holds logits of colours: its prunes work on the colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import pytest
import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallbackLocation

from sundae_ns.gaussians.parameters import rgb_to_sh, sh_to_rgb
from sundae_ns.model import SundaeModel
from sundae_ns.pruning import PruningConfig, decide
from sundae_ns.viewer import Rule, rule_config

Build = Callable[..., SundaeModel]
TrainingOf = Callable[[SundaeModel], Any]


def test_a_prune_merges_colours(build: Build, training_of: TrainingOf, datamanager: Any) -> None:
    model = build(sh_degree=0)
    training = training_of(model)
    with torch.no_grad():
        model.gauss_params["features_dc"].mul_(4)
    field = {name: value.detach().clone() for name, value in model.gauss_params.items()}
    field["features_dc"] = rgb_to_sh(field["features_dc"].sigmoid())
    config = replace(model.config.pruning, logits=False)
    expected = decide(field, config, lambda: model.contribution(datamanager)).values
    assert expected is not None
    training.run_callbacks(TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, 3)
    training.callbacks[-1].run_callback_at_location(3, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
    assert torch.equal(model.means, expected["means"])
    found = model.gauss_params["features_dc"].detach().sigmoid()
    torch.testing.assert_close(found, sh_to_rgb(expected["features_dc"]), rtol=0, atol=2e-3)


@pytest.mark.parametrize("degree", [0, 1])
def test_whoever_prunes_is_told_what_colours_are(build: Build, degree: int) -> None:
    model = build(sh_degree=degree, pruning={"mode": "auto"})
    assert model.budget is not None
    asked = [model.policy.config, model.budget.config]
    asked += [rule_config(model.config.pruning, rule, 0.3) for rule in get_args(Rule)]
    assert [config.logits for config in asked] == [degree == 0] * len(asked)


def test_no_user_is_asked(capsys: pytest.CaptureFixture[str]) -> None:
    assert tyro.cli(PruningConfig, args=["--gamma", "0.25"]) == PruningConfig(gamma=0.25)
    with pytest.raises(SystemExit):
        tyro.cli(PruningConfig, args=["--help"])
    shown = capsys.readouterr().out
    assert "--gamma" in shown
    assert "logits" not in shown
