"""What a search for a budget takes from a checkpoint, and what it refuses before it has changed anything."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.errors import CheckpointError
from sundae_ns.pruning import PruningConfig
from sundae_ns.training.budget import Budget
from sundae_ns.training.budget.search import Search

FIELD = {"field": {"means": torch.zeros(2, 3)}}


def budget() -> Budget:
    return Budget(PruningConfig(mode="auto", stop=20000), HeadConfig())


def numbers(phase: str, *, trying: bool = False) -> dict[str, Any]:
    search = Search(reference=30.1, target=30.0)
    search.begin(phase, 1000)  # type: ignore[arg-type]
    if trying:
        search.cut(30.2, 500, step=3)
    return search.state()


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        (None, "without a search"),
        ([1], "without a search"),
        ({}, "without a search"),
        ({"numbers": 3}, "without a search"),
        ({"numbers": {}}, "where its search for a budget stood"),
        ({"numbers": numbers("field", trying=True)}, "lacks the field"),
        ({"numbers": numbers("field", trying=True), "accepted": [1]}, "lacks the field"),
        ({"numbers": numbers("bands"), "accepted": FIELD}, "lacks the field"),
        ({"numbers": numbers("head"), "fallback": 3}, "lacks the field"),
    ],
)
def test_a_state_that_cannot_be_gone_on_with_is_refused_and_changes_nothing(state: Any, reason: str) -> None:
    made = budget()
    before = made.state()
    with pytest.raises(CheckpointError, match=reason) as raised:
        made.load_state(state)
    assert "\n" not in str(raised.value)
    assert made.state() == before


@pytest.mark.parametrize("phase", ["field", "bands", "head", "done"])
def test_a_state_goes_from_one_search_to_the_next(phase: str) -> None:
    made = budget()
    made.load_state({"numbers": numbers(phase, trying=True), "accepted": FIELD, "fallback": FIELD, "flat": None})
    assert made.search.phase == phase
    assert made.search.trying
    again = budget()
    again.load_state(made.state())
    assert again.state() == made.state()


def test_once_it_is_decided_that_a_scene_needs_no_head_there_is_none() -> None:
    made = budget()
    assert made.head_config == HeadConfig()
    made.search.head_size, made.search.num_features = "tiny", 5
    assert made.head_config == HeadConfig(size="tiny", num_features=5)
    made.search.head_dropped, made.search.head_size, made.search.num_features = True, "", 0
    assert made.head_config is None
    expected = {"gauss_params.features": torch.zeros(2, 13), "head.weight": torch.zeros(3)}
    extra = {"method": "sundae", "budget": {"numbers": {**made.search.state(), "degree": -1}}}
    shaped = made.shapes(extra, expected)
    assert {name: value.shape for name, value in shaped.items()} == {"gauss_params.features": (2, 0)}
    assert made.prepare_head(extra, CompensationHead(HeadConfig())) is None


def test_of_another_methods_checkpoint_nothing_is_known() -> None:
    expected = {"gauss_params.means": torch.zeros(2, 3)}
    for extra in (None, 3, {}, {"method": "splatfacto"}):
        assert budget().shapes(extra, expected) == expected
