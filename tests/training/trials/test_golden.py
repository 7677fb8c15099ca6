"""Recorded trials in, the choices that they led to out: of the count, of the head, and of the length."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.trials.count import CountTrialProgress, CountTrials
from sundae_ns.training.trials.curve import head_pays, is_lost, still_climbs
from sundae_ns.training.trials.engine import TrialEngine
from sundae_ns.training.trials.head import HeadTrialProgress
from sundae_ns.training.trials.stopping import StoppingProgress

GOLDEN = json.loads(Path(__file__).with_name("golden.json").read_text())
"""Means of ``curve_fit.csv`` and ``verdicts.csv`` with a spread over views, and choices of commit f91e763."""


def count_choice(measured: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """What trials of counts decide."""
    config = PruningConfig(keep_ratio=None, **options)
    trials = CountTrials(config, None, TrialEngine(), alone=False)  # type: ignore[arg-type]
    trials.progress = progress = CountTrialProgress(phase="trials", **measured)
    plain, tolerance = progress.plain_curve(), trials._tolerance
    asks_for_head = trials._choice(plain)[0] > round(0.1 * progress.full)
    if len(progress.head) == 2:
        progress.head_pays = head_pays(plain, progress.head_gain(), tolerance)
    curve = progress.curve()
    count, reason = trials._choice(curve)
    return {
        "chosen": count,
        "reason": reason,
        "asks_for_head": asks_for_head,
        "head_pays": progress.head_pays,
        "lost": [is_lost(point, tolerance) for point in plain],
        "climbs": still_climbs(curve, tolerance),
        "curve": [asdict(point) for point in curve],
    }


def head_choice(measured: Mapping[str, Any]) -> str:
    """What trials of the head decide."""
    return HeadTrialProgress(**measured).best


def length_choice(measured: list[list[float]]) -> list[list[Any]]:
    """Best number of windows, and whether training has lost, after each window of a watch."""
    watches = [StoppingProgress(measured=measured[: done + 1]) for done in range(len(measured))]
    return [[watch.best, watch.lost] for watch in watches]


@pytest.mark.parametrize("case", GOLDEN["counts"], ids=lambda case: case["name"])
def test_the_count(case: dict[str, Any]) -> None:
    found = count_choice(case["measured"], case["options"])
    for point, expected in zip(found.pop("curve"), case["choice"]["curve"], strict=True):
        assert point.pop("bytes") == expected["bytes"]
        assert point == pytest.approx({name: value for name, value in expected.items() if name != "bytes"}, rel=1e-12)
    assert found == {name: value for name, value in case["choice"].items() if name != "curve"}


@pytest.mark.parametrize("case", GOLDEN["heads"], ids=lambda case: case["name"])
def test_the_head(case: dict[str, Any]) -> None:
    assert head_choice(case["measured"]) == case["choice"]


@pytest.mark.parametrize("case", GOLDEN["lengths"], ids=lambda case: case["name"])
def test_the_length(case: dict[str, Any]) -> None:
    assert length_choice(case["measured"]) == case["choice"]
