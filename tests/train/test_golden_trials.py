"""Recorded trials in, the choices that they led to out: of the count, of the head, and of the length."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from sundae_ns.train import choice
from sundae_ns.train.choice import HEADS, HeadGain, Tolerance, Tried

GOLDEN = json.loads(Path(__file__).with_name("golden_trials.json").read_text())
"""Means of ``curve_fit.csv`` and ``verdicts.csv`` with a spread over views, and choices of commit f91e763."""


def count_choice(measured: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """What trials of counts decide."""
    rows = zip(measured["counts"], measured["measured"], measured["sizes"], strict=True)
    plain = choice.curve_of([Tried("count", n, "plain", 600, views, size and [size, 0]) for n, views, size in rows])
    tolerance, pays, curve = Tolerance.of_drop(options.get("max_drop")), None, plain
    limits = {"most": options.get("max_gaussians"), "most_bytes": options.get("max_bytes")}
    tenth = round(0.1 * measured["full"])
    if "head" in measured:
        trials = zip(HEADS, measured["head"], measured["head_bytes"], strict=False)
        gain = HeadGain.of(*(Tried("tenth", tenth, head, 1200, views, size) for head, views, size in trials))
        pays = choice.head_pays(plain, gain, tolerance)
        curve = choice.with_head(plain, gain) if pays else plain
    count, reason = choice.choose_within(curve, tolerance, **limits)
    return {
        "chosen": count,
        "reason": reason,
        "asks_for_head": choice.choose_within(plain, tolerance, **limits)[0] > tenth,
        "head_pays": pays,
        "lost": [choice.is_lost(point, tolerance) for point in plain],
        "curve": [asdict(point) for point in curve],
    }


@pytest.mark.parametrize("case", GOLDEN["counts"], ids=lambda case: case["name"])
def test_the_count(case: dict[str, Any]) -> None:
    found = count_choice(case["measured"], case["options"])
    for point, expected in zip(found.pop("curve"), case["choice"]["curve"], strict=True):
        assert point.pop("bytes") == expected["bytes"]
        assert point == pytest.approx({name: value for name, value in expected.items() if name != "bytes"}, rel=1e-12)
    assert found == {name: value for name, value in case["choice"].items() if name != "curve"}


@pytest.mark.parametrize("case", GOLDEN["heads"], ids=lambda case: case["name"])
def test_the_head(case: dict[str, Any]) -> None:
    folds, size = case["measured"]["folds"], case["measured"]["bytes"]
    tried = [
        Tried("head", 50_000, HEADS[number // folds], 1200, views, [size[number // folds], 0])
        for number, views in enumerate(case["measured"]["measured"])
    ]
    assert choice.best_head(tried, folds) == case["choice"]


@pytest.mark.parametrize("case", GOLDEN["lengths"], ids=lambda case: case["name"])
def test_the_length(case: dict[str, Any]) -> None:
    losses = [loss for loss, *_ in case["measured"]]
    assert [list(choice.best_length(losses[: done + 1])) for done in range(len(losses))] == case["choice"]
