"""What a budget search takes from a checkpoint, and what it refuses before it has changed anything."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import pytest
import torch

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.errors import CheckpointError
from sundae_ns.gaussians.field import Field
from sundae_ns.training.budget import BudgetSearch
from sundae_ns.training.budget.search import SearchProgress
from sundae_ns.training.densification import ChainStrategy, Densification
from sundae_ns.training.field_state import FieldState
from sundae_ns.training.pruning_config import PruningConfig

FIELD = {"counted": 0, "field": {"means": torch.zeros(2, 3)}}


def a_state() -> FieldState:
    """A field of two primitives of SH degree 3, with a tiny head."""
    params = {"means": torch.zeros(2, 3), "features_rest": torch.zeros(2, 15, 3), "features": torch.zeros(2, 13)}
    return FieldState(Field(params), torch.nn.ModuleDict({"head": CompensationHead(HeadConfig(size="tiny"))}))


def a_search(state: FieldState) -> BudgetSearch:
    config = PruningConfig(mode="auto", stop=20000)
    return BudgetSearch(config, HeadConfig(size="tiny"), Densification(ChainStrategy(cap=10)), state)


def numbers(phase: str, *, trying: bool = False, **changes: Any) -> dict[str, Any]:
    search = SearchProgress(reference=30.1, target=30.0)
    search.begin(phase, 1000)  # type: ignore[arg-type]
    if trying:
        search.cut(30.2, 500, step=3)
    return {**asdict(search), **changes}


@pytest.mark.parametrize(
    ("saved", "reason"),
    [
        ({}, "without a budget search"),
        ({"numbers": 3}, "without a budget search"),
        ({"numbers": {}}, "damaged budget search"),
        ({"numbers": numbers("field", trying=True)}, "lacks a field"),
        ({"numbers": numbers("field", trying=True), "engine": {"kept": {"accepted": [1]}}}, "lacks a field"),
        ({"numbers": numbers("degrees"), "engine": {"kept": {"accepted": FIELD}}}, "lacks a field"),
        ({"numbers": numbers("head"), "engine": {"kept": {"fallback": 3}}}, "lacks a field"),
    ],
)
def test_a_state_that_cannot_be_resumed_is_refused_and_changes_nothing(saved: Any, reason: str) -> None:
    state = a_state()
    extension = a_search(state)
    before = extension.state_dict()
    with pytest.raises(CheckpointError, match=reason) as raised:
        extension.load_state_dict(state, saved)
    assert "\n" not in str(raised.value)
    assert extension.state_dict() == before


@pytest.mark.parametrize("phase", ["field", "degrees", "head", "done"])
def test_a_state_goes_from_one_search_to_the_next(phase: str) -> None:
    state = a_state()
    first, second = a_search(state), a_search(state)
    saved = {
        "numbers": numbers(phase, trying=True),
        "engine": {"kept": {"accepted": FIELD, "fallback": FIELD}},
        "flat": None,
    }
    first.load_state_dict(state, saved)
    assert first.search.phase == phase
    assert first.search.trying
    second.load_state_dict(state, first.state_dict())
    assert second.state_dict() == first.state_dict()


@pytest.mark.parametrize("enabled", [True, False])
def test_the_search_enables_the_head(enabled: bool) -> None:
    state = a_state()
    extension = a_search(state)
    assert state.head_starts_at == math.inf
    extension.load_state_dict(state, {"numbers": numbers("done", head=enabled)})
    assert state.head_enabled == enabled


def test_a_checkpoint_gives_field_and_head_their_shapes() -> None:
    state = a_state()
    extension = a_search(state)
    extension.prepare_loading(state, {"numbers": numbers("done", degree=1, head_size="tiny", num_features=5)})
    assert [state.field[name].shape for name in ("features_rest", "features")] == [(2, 3, 3), (2, 5)]
    assert state.head is not None
    assert state.head.config.num_features == 5


def test_once_the_search_has_decided_against_a_head_there_is_none() -> None:
    state = a_state()
    extension = a_search(state)
    extension.prepare_loading(state, {"numbers": numbers("done", head_dropped=True, num_features=0)})
    assert state.head is None
    assert state.field["features"].shape == (2, 0)
    assert state.field["features_rest"].shape == (2, 15, 3), "the degree is not known yet"
