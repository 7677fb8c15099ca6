"""The search for a budget by itself: what it accepts, takes back and tries next."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from sundae_ns.errors import CheckpointError
from sundae_ns.pruning.search import DEEPEST, SHALLOWEST, Point, Search


def search(accepted: int = 1000, **options: Any) -> Search:
    made = Search(reference=30.1, target=30.0, **options)
    made.begin("field", accepted)
    return made


def play(found: Search, recovered: Any, *, patience: int = 4, least: int = 5, looks: int = 200) -> list[int]:
    """Search on a field whose PSNR is a function of its count once it has recovered, half the way a look; cuts made."""
    psnr, count, before, cuts = recovered(found.accepted), found.accepted, found.accepted, []
    for look in range(looks):
        count = count if found.trying else found.accepted
        psnr += 0.5 * (recovered(count) - psnr)
        verdict = found.judge(psnr, look, patience)
        if verdict == "waiting":
            continue
        if verdict == "rejected":
            count, psnr = before, found.target + found.margin
        assert count == found.accepted
        if found.rejected >= 3:
            break
        following = found.next_count(psnr, least)
        if following is not None:
            before = count
            found.cut(psnr, following, look)
            cuts.append(following)
            count, psnr = following, psnr - 3.0
    return cuts


@pytest.mark.parametrize("needed", [7, 40, 130, 600, 950])
def test_finds_about_what_a_scene_needs(needed: int) -> None:
    def recovered(count: int) -> float:
        return 30.0 + 2.0 * math.log2(count / needed)

    found = search()
    play(found, recovered, patience=8)
    assert needed <= found.accepted <= 1.3 * needed + 1
    assert recovered(found.accepted) >= found.target


def test_nothing_is_cut_where_nothing_can_go() -> None:
    found = search()
    play(found, lambda count: 30.01 if count == 1000 else 20.0)
    assert (found.accepted, found.rejected) == (1000, 1)
    assert found.steps_lost > 0


def test_a_field_that_needs_nothing_is_cut_to_the_least() -> None:
    found = search()
    cuts = play(found, lambda _: 40.0, least=17)
    assert found.accepted == cuts[-1] == 17
    assert cuts[:3] == [500, 250, 125]
    assert found.next_count(40.0, 17) is None


def test_a_cut_is_taken_back_once_it_cannot_recover_any_more() -> None:
    found = search()
    found.cut(30.1, 500, step=100)
    assert found.judge(28.0, 110, patience=5) == "waiting"
    assert found.judge(28.6, 120, patience=5) == "waiting"  # 3 looks of 0.6 are enough
    assert found.judge(28.8, 130, patience=5) == "rejected"  # 2 looks of 0.2 are not
    assert (found.rejected, found.steps_lost, found.accepted) == (1, 30, 1000)
    assert found.slope == pytest.approx(0.1 + 1.2)


def test_patience_ends() -> None:
    found = search()
    found.cut(30.1, 500, step=0)
    verdicts = [found.judge(psnr, step, patience=3) for step, psnr in enumerate((20.0, 27.0, 29.9))]
    assert verdicts == ["waiting", "waiting", "rejected"]


def test_what_has_failed_is_come_up_to_from_above() -> None:
    found = search()
    found.cut(30.1, 500, step=0)
    assert found.judge(29.0, 1, patience=1) == "rejected"
    assert found.next_count(40.0, 1) == int(1000 * 0.5**0.5)
    found.accepted = 520
    assert found.next_count(40.0, 1) == found.next_count(30.5, 1) == int(520 * 0.5**SHALLOWEST)
    found.begin("head", 520)
    assert found.next_count(40.0, 1) == 260


def test_how_deep_to_cut_follows_from_what_the_last_cut_cost() -> None:
    found = search()
    assert found.next_count(30.0, 1) == round(1000 * 0.5**DEEPEST)
    found.cut(31.0, 500, step=0)
    assert found.judge(30.4, 1, patience=4) == "accepted"
    assert found.slope == pytest.approx(0.6)
    assert found.next_count(30.3, 1) == int(500 * 0.5**0.5)
    assert found.next_count(30.05, 1) is None
    assert search().next_count(29.99, 1) is None, "a field below the target is trained, not cut"
    assert found.judge(30.05, 2, patience=4) == "resting"
    found.cut(30.3, 353, step=3)
    assert found.judge(30.3, 4, patience=4) == "accepted"
    assert found.slope == pytest.approx(0.3), "a lucky cut does not make the next one cheap"


@pytest.mark.parametrize(
    ("values", "order", "lowest"),
    [
        ({3: 30.0, 2: 30.0, 1: 29.95, 0: 29.95}, [3, 1, 0], 0),
        ({3: 30.0, 2: 29.95, 1: 29.5, 0: 29.0}, [3, 1, 2], 2),
        ({3: 30.0, 2: 29.5, 1: 29.5, 0: 30.5}, [3, 1, 2], 3),
        ({3: 30.0, 2: 30.0, 1: 29.95, 0: 29.0}, [3, 1, 0], 1),
        ({1: 30.0, 0: 30.2}, [1, 0], 0),
    ],
)
def test_degrees_are_bisected(values: dict[int, float], order: list[int], lowest: int) -> None:
    found, top, tried = Search(), max(values), []
    while (degree := found.next_degree(top, 0.1)) is not None:
        tried.append(degree)
        found.degrees[str(degree)] = values[degree]
    assert tried == order
    assert found.lowest_degree(top, 0.1) == lowest


def test_state_goes_through_a_checkpoint() -> None:
    found = search()
    found.cut(30.1, 500, step=100)
    found.curve.append(Point(1, "field", 10, 100, 30.0, "waiting", 5))
    assert Search.from_state(found.state()) == found
    assert json.loads(json.dumps(found.state()))["curve"][0]["primitives"] == 10


@pytest.mark.parametrize(
    "change",
    [{"phase": "lunch"}, {"accepted": "many"}, {"degree": 9}, {"curve": [{"step": 1}]}, {"new": 1}, {"cuts": 0.5}],
)
def test_a_foreign_state_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(CheckpointError, match="search for a budget"):
        Search.from_state({**search().state(), **change})
