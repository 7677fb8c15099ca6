"""Outputs that are made when they are looked at."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from sundae_ns.model import SundaeModel

Build = Callable[..., SundaeModel]
Perturb = Callable[[SundaeModel], SundaeModel]
MakeCamera = Callable[..., Cameras]


def test_outputs_that_nobody_asks_for_cost_nothing(
    build: Build, perturb: Perturb, camera: MakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = perturb(build()).eval()
    splatted: list[int] = []
    rendering = sys.modules["sundae_ns.rendering.render"]  # its name is also that of a function
    rasterize = rendering.rasterize
    monkeypatch.setattr(rendering, "rasterize", lambda *a, **kwargs: splatted.append(1) or rasterize(*a, **kwargs))
    outputs = model.get_outputs_for_camera(camera())
    assert outputs["rgb"].shape == outputs["base_rgb"].shape
    assert (len(splatted), model._response._last[0]) == (1, None)
    assert outputs["response"].max() > 0
    assert len(splatted) == 2


def test_outputs_belong_to_the_field_that_was_rendered(build: Build, perturb: Perturb, camera: MakeCamera) -> None:
    model = perturb(build()).eval()
    before = {name: value.clone() for name, value in model.get_outputs_for_camera(camera()).items()}
    outputs = model.get_outputs_for_camera(camera())
    with torch.no_grad():  # a prune, while another thread still shows the picture
        for name, value in model.gauss_params.items():
            model.gauss_params[name] = torch.nn.Parameter(value[::2].clone())
        model.state.pruning["num_prunes"] += 1
    assert {name for name, value in outputs.items() if not torch.equal(value, before[name])} == set()
    after = model.get_outputs_for_camera(camera())
    assert not torch.equal(after["response"], before["response"])


@torch.no_grad()
@pytest.mark.parametrize("n", [1, 5])
def test_one_primitive_has_no_response_to_show_and_few_have_one(build: Build, camera: MakeCamera, n: int) -> None:
    picture = build(n=n).eval().get_outputs_for_camera(camera())["response"]
    assert picture.isfinite().all()
    assert bool(picture.any()) == (n > 1)
