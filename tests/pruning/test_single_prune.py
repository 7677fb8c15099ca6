"""Options of one prune derived from those of a run, and decisions on a given graph."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from prunes import decide_share
from torch import Tensor

import sundae_ns.pruning.decision
from sundae_ns.pruning import PruningConfig, band_rule, field_graph, single_prune
from sundae_ns.training.schedules import make_schedule

N = 80


def field() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (3, 3), "opacities": (1,)}
    made = {name: torch.randn(N, *shape, generator=generator) for name, shape in {"means": (3,), **shapes}.items()}
    return {**made, "scales": made["scales"] - 2}


@pytest.mark.parametrize(
    "options",
    [
        {"mode": "auto", "max_psnr_drop": 0.2, "stop": 15000, "start": 30000},
        {"mode": "auto", "max_bytes": 1000},
        {"mode": "continuous", "target_primitives": 10, "max_primitives": 20},
        {"mode": "off"},
    ],
)
def test_schedules_and_budgets_are_ignored(options: dict[str, Any]) -> None:
    config = PruningConfig(**options)
    config.validate()
    single = single_prune(config, 0.25)
    single.validate()
    assert (make_schedule(single).target(N), single.settled_at) == (N // 4, single.prune_at)
    expected = decide_share(field(), PruningConfig(keep_ratio=0.25), lambda: torch.ones(N)).mask
    assert torch.equal(decide_share(field(), single, lambda: torch.ones(N)).mask, expected)


def test_the_band_rule_is_the_papers() -> None:
    config = PruningConfig(signal="positions", num_neighbors=7, seed=3)
    paper = PruningConfig(
        signal="positions",
        num_neighbors=7,
        keep_ratio=0.2,
        gamma=0.7,
        score="response",
        selection="band",
        edges="centres",
        redistribution="none",
    )
    found = decide_share(field(), band_rule(config, 0.2, 0.7))
    assert torch.equal(found.mask, decide_share(field(), paper).mask)
    assert found.values is None


@pytest.mark.parametrize("options", [{}, {"score": "response", "selection": "band", "redistribution": "none"}])
def test_a_given_graph_is_used_and_changes_nothing(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    params, config = field(), PruningConfig(keep_ratio=0.3, **options)
    params["opacities"][4] = torch.nan
    usable = {name: value[torch.arange(N) != 4] for name, value in params.items()}
    expected, graph = decide_share(params, config, lambda: torch.ones(N)), field_graph(usable, config)
    monkeypatch.delattr(sundae_ns.pruning.decision, "field_graph")
    found = decide_share(params, config, lambda: torch.ones(N), graph=graph)
    assert torch.equal(found.mask, expected.mask)
    for name, value in (expected.values or {}).items():
        assert torch.equal((found.values or {})[name], value)
    # A rule without a graph ignores it.
    assert decide_share(params, PruningConfig(score="opacity", redistribution="none"), graph=graph).tau is None
