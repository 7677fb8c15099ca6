"""Outputs that are computed when they are asked for."""

from __future__ import annotations

import copy
from threading import Barrier, Thread

import pytest
import torch

from sundae_ns.rendering.frames import Later, LazyOutputs


@pytest.fixture
def calls() -> list[str]:
    return []


@pytest.fixture
def outputs(calls: list[str]) -> LazyOutputs:
    def make(name: str) -> str:
        calls.append(name)
        return name.upper()

    return LazyOutputs(rgb="RGB", depth=Later(lambda: make("depth")), features=Later(lambda: make("features")))


def test_names_cost_nothing(outputs: LazyOutputs, calls: list[str]) -> None:
    assert list(outputs) == list(outputs.keys()) == ["rgb", "depth", "features"]
    assert len(outputs) == 3
    assert "depth" in outputs
    assert outputs["rgb"] == "RGB"
    assert calls == []


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


def test_values_can_be_replaced_and_added(outputs: LazyOutputs, calls: list[str]) -> None:
    outputs["depth"] = outputs["rgba"] = 1
    assert (outputs["depth"], outputs["rgba"]) == (1, 1)
    assert calls == []


def test_an_unknown_name_is_a_key_error(outputs: LazyOutputs) -> None:
    with pytest.raises(KeyError, match="accumulation"):
        outputs["accumulation"]


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
