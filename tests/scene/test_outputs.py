"""Outputs that are computed when they are asked for."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from threading import Barrier, Thread

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from sundae_ns.plugin.model import SundaeModel
from sundae_ns.scene.frames import Later, LazyOutputs

Build = Callable[..., SundaeModel]
Perturb = Callable[[SundaeModel], SundaeModel]
MakeCamera = Callable[..., Cameras]


def test_outputs_that_nobody_asks_for_cost_nothing(
    build: Build, perturb: Perturb, camera: MakeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = perturb(build()).eval()
    splatted: list[int] = []
    rendering = sys.modules["sundae_ns.scene.render"]  # its name is also that of a function
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


@pytest.fixture
def calls() -> list[str]:
    return []


@pytest.fixture
def outputs(calls: list[str]) -> LazyOutputs:
    def make(name: str) -> str:
        calls.append(name)
        return name.upper()

    return LazyOutputs(rgb="RGB", depth=Later(lambda: make("depth")), features=Later(lambda: make("features")))


def test_each_is_made_once(outputs: LazyOutputs, calls: list[str]) -> None:
    assert [outputs["depth"], outputs["depth"], outputs.get("depth")] == ["DEPTH"] * 3
    assert calls == ["depth"]


def test_every_way_to_a_value_makes_it(outputs: LazyOutputs) -> None:
    whole = {"rgb": "RGB", "depth": "DEPTH", "features": "FEATURES"}
    for look in (dict, lambda o: {**o}, lambda o: dict(o.items()), lambda o: dict(zip(o, o.values(), strict=True))):
        assert look(copy.copy(outputs)) == whole
    assert isinstance(outputs.data["depth"], Later)
    assert outputs.pop("depth") == "DEPTH"
    assert list(outputs) == ["rgb", "features"]


def test_without_gradients() -> None:
    weight = torch.ones(1, requires_grad=True)
    assert not LazyOutputs(x=Later(lambda: 2 * weight))["x"].requires_grad


def test_two_threads_get_values() -> None:
    barrier = Barrier(2, timeout=10)
    found: list[object] = []

    def make() -> int:
        barrier.wait()  # both are in here before either has its value
        return 3

    outputs = LazyOutputs(x=Later(make))
    threads = [Thread(target=lambda: found.append(outputs["x"])) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [3, 3]
