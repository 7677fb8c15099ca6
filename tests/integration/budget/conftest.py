"""Trainers and a finished run that search for a budget."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from budget_runs import Make, Run, set_up, tidy
from ray_tracing import write_still_life

from sundae_ns.compensation import HeadConfig
from sundae_ns.training.budget import heads


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("budget") / "scene"
    return write_still_life(folder, train_views=12, test_views=2, width=24, height=24, points=200, samples=1)


@pytest.fixture
def make(scene: Path, tmp_path: Path) -> Iterator[Make]:
    yield lambda **options: set_up(scene, tmp_path, **options)
    tidy()


@pytest.fixture(scope="module")
def done(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    trainer = set_up(scene, tmp_path_factory.mktemp("done"))
    trainer.train()
    yield Run(trainer)
    tidy()


@pytest.fixture
def small_head(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Options of a head with 13 features. The search enables one of 500 kB with 5, beside a field of a few kB."""
    monkeypatch.setattr(heads, "head_for", lambda _count, _row, largest: replace(largest, size="tiny", num_features=5))
    return {"head": HeadConfig(mode="residual", size="small", pixel_unshuffle=1, num_features=13)}
