"""Rules derived from others, and decisions on a given graph."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
import torch
from prunes import decide_share
from torch import Tensor

import sundae_ns.pruning.decision
from sundae_ns.pruning import PruneRule, band_rule, field_graph
from sundae_ns.training.pruning_config import PruningConfig

N = 80


def field() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (3, 3), "opacities": (1,)}
    made = {name: torch.randn(N, *shape, generator=generator) for name, shape in {"means": (3,), **shapes}.items()}
    return {**made, "scales": made["scales"] - 2}


def test_a_rule_knows_no_schedule() -> None:
    names = {option.name for option in fields(PruneRule)}
    assert not names & {"mode", "keep_ratio", "prune_at", "start", "stop", "every", "max_primitives", "max_bytes"}


@pytest.mark.parametrize(
    "options",
    [
        {"keep_ratio": None, "max_drop": 0.2, "stop": 15000, "start": 30000},
        {"keep_ratio": None, "max_bytes": 1000},
        {"mode": "continuous", "target_primitives": 10, "max_primitives": 20},
        {"mode": "off"},
    ],
)
def test_the_schedule_that_comes_with_a_rule_is_ignored(options: dict[str, Any]) -> None:
    expected = decide_share(field(), PruneRule(), 0.25, torch.ones(N)).mask
    assert torch.equal(decide_share(field(), PruningConfig(**options), 0.25, torch.ones(N)).mask, expected)


def test_the_band_rule_is_the_papers() -> None:
    paper = PruneRule(
        signal="positions",
        num_neighbors=7,
        gamma=0.7,
        score="response",
        selection="band",
        edges="centres",
        redistribution="none",
    )
    found = decide_share(field(), band_rule(PruneRule(signal="positions", num_neighbors=7, seed=3), 0.7), 0.2)
    assert torch.equal(found.mask, decide_share(field(), paper, 0.2).mask)
    assert found.values is None


@pytest.mark.parametrize("options", [{}, {"score": "response", "selection": "band", "redistribution": "none"}])
def test_a_given_graph_is_used_and_changes_nothing(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    params, rule, weights = field(), PruneRule(**options), torch.ones(N)
    params["opacities"][4] = torch.nan
    usable = {name: value[torch.arange(N) != 4] for name, value in params.items()}
    expected, graph = decide_share(params, rule, 0.3, weights), field_graph(usable, rule)
    monkeypatch.delattr(sundae_ns.pruning.decision, "field_graph")
    found = decide_share(params, rule, 0.3, weights, graph)
    assert torch.equal(found.mask, expected.mask)
    for name, value in (expected.values or {}).items():
        assert torch.equal((found.values or {})[name], value)
    # A rule without a graph ignores it.
    assert decide_share(params, PruneRule(score="opacity", redistribution="none"), graph=graph).tau is None
