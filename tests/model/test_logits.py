"""A model without harmonics, whose first band holds logits of colours: its prunes work on the colours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from sundae_ns.gaussians.gaussians import Field, sh_to_rgb
from sundae_ns.model import SundaeModel
from sundae_ns.pruning import decide

Build = Callable[..., SundaeModel]
TrainingOf = Callable[[SundaeModel], Any]


def test_a_prune_merges_colours(build: Build, training_of: TrainingOf, datamanager: Any) -> None:
    model = build(sh_degree=0)
    training = training_of(model)
    with torch.no_grad():
        model.gauss_params["features_dc"].mul_(4)
    assert model.state.field.encoding == "logits"
    harmonics = Field({name: value.detach().clone() for name, value in model.state.field.as_harmonics().items()})
    count = model.num_points // 2
    expected = decide(harmonics, model.config.pruning, count, model.contribution(datamanager, count)).values
    assert expected is not None
    training.act("pruning", 3)
    assert torch.equal(model.means, expected["means"])
    found = model.gauss_params["features_dc"].detach().sigmoid()
    torch.testing.assert_close(found, sh_to_rgb(expected["features_dc"]), rtol=0, atol=2e-3)
