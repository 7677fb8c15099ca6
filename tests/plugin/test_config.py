"""What the model is to nerfstudio, and options that cannot work."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from nerfstudio.models.splatfacto import SplatfactoModel

from sundae_ns.core.errors import BackendError, ConfigError
from sundae_ns.plugin.model import SundaeModel

Build = Callable[..., SundaeModel]
TrainingOf = Callable[[SundaeModel], Any]


def test_it_is_a_splatfacto_whose_groups_have_features_and_head(build: Build) -> None:
    model = build()
    assert isinstance(model, SplatfactoModel)
    groups = model.get_param_groups()
    assert set(groups) == {*model.gauss_params, "compensation"}
    assert "features" in groups
    assert set(build(head={"mode": "off"}).get_param_groups()) == set(groups) - {"compensation", "features"}


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({"pruning": {"keep_ratio": 0.0}}, "keep_ratio"),
        ({"pruning": {"keep_ratio": 1.2}}, "keep_ratio"),
        ({"pruning": {"gamma": -0.1}}, "gamma"),
        ({"pruning": {"gamma": 1.5}}, "gamma"),
        ({"head": {"num_features": 0}}, "num-features"),
        ({"base_loss_weight": -1.0}, "base-loss-weight"),
        ({"use_bilateral_grid": True}, "bilateral"),
    ],
)
def test_options_that_cannot_work(build: Build, options: dict[str, Any], cause: str) -> None:
    with pytest.raises(ConfigError, match=cause) as caught:
        build(**options)
    assert "\n" not in str(caught.value)


def test_gsplat_without_cuda(build: Build, training_of: TrainingOf, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    model = build(rasterizer="gsplat")
    with pytest.raises(BackendError, match="CUDA is not available") as caught:
        training_of(model)
    assert "\n" not in str(caught.value)
    assert build(rasterizer="auto").backend.name == "cpu"
