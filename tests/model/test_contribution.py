"""What each primitive contributes to the training pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from sundae_ns.model import SundaeModel

Build = Callable[..., SundaeModel]

N = 60
"""Primitives of a model that is built without a count."""


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_contribution_is_the_weight_in_the_pictures(build: Build, datamanager: Any, mode: str) -> None:
    model = build(pruning={"score": "contribution"}, rasterize_mode=mode)
    # Thinner than a pixel, where the two modes differ by far.
    model.gauss_params["scales"].data[:30] = -6.0
    model.gauss_params["means"].data[4] = torch.tensor([0.0, 0.0, 50.0])
    total = model.contribution(datamanager)
    assert total.shape == (N,)
    assert not total.requires_grad
    assert (total >= 0).all()
    assert total[4] == 0
    model.eval()
    with torch.no_grad():
        alphas = [model.get_outputs_for_camera(view)["accumulation"] for view in datamanager.training_cameras()]
    assert float(total.sum()) == pytest.approx(float(torch.stack(alphas).sum()), rel=1e-4)


def test_contribution_to_detail_weighs_the_pixels_and_is_the_same_each_time(build: Build, datamanager: Any) -> None:
    plain, weighted = (build(pruning={"score": f"{name}contribution"}) for name in ("", "detail-"))
    weighted.gauss_params.load_state_dict(plain.gauss_params.state_dict())
    found = [model.contribution(datamanager) for model in (plain, weighted, weighted)]
    assert torch.equal(found[1], found[2])
    assert torch.equal(found[1] > 0, found[0] > 0)
    seen = found[0] > 0
    ratio = found[1][seen] / found[0][seen]
    assert float(ratio.max()) > 1.1
    assert float(ratio.min()) < 0.9
