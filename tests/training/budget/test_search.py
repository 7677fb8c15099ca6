"""Decisions of a budget search: what it accepts, takes back and tries next."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import pytest

from sundae_ns.errors import CheckpointError
from sundae_ns.training.budget.search import DEEPEST, NO_IMAGE, SHALLOWEST, Point, SearchProgress


def search(accepted: int = 1000, **options: Any) -> SearchProgress:
    made = SearchProgress(reference=30.1, target=30.0, **options)
    made.begin("field", accepted)
    return made


END = 200
"""Steps of training, with an evaluation after each."""


def play(found: SearchProgress, recovered: Callable[[int], float], *, patience: int = 4, least: int = 5) -> list[int]:
    """The cuts of a search on a field that recovers half of the way to a PSNR by its count in each step."""
    psnr, count, before, cuts = recovered(found.accepted), found.accepted, found.accepted, []
    for step in range(1, END + 1):
        count = count if found.trying else found.accepted
        psnr += 0.5 * (recovered(count) - psnr)
        verdict = found.judge(psnr, step, END - step, patience)
        if verdict == "waiting":
            continue
        if verdict == "rejected":
            count, psnr = before, found.before_cut
        assert count == found.accepted
        if found.rejected >= 5:
            break
        following = found.next_count(psnr, least, patience)
        if following is not None and step < END:
            before = count
            found.cut(psnr, following, step)
            cuts.append(following)
            count, psnr = following, psnr - 3.0
    assert not found.trying, "the last evaluation decides"
    return cuts


def verdicts(found: SearchProgress, *values: float, left: int = 100, patience: int = 4) -> list[str]:
    """Verdicts of evaluations of a cut, every 10 steps, with ``left`` steps after the last of them."""
    steps = range(found.cut_at + 10, found.cut_at + 10 * len(values) + 1, 10)
    return [found.judge(psnr, step, left + steps[-1] - step, patience) for psnr, step in zip(values, steps)]


@pytest.mark.parametrize("needed", [7, 40, 130, 600, 950])
def test_finds_about_what_a_scene_needs(needed: int) -> None:
    def recovered(count: int) -> float:
        return 30.0 + 2.0 * math.log2(count / needed)

    found = search()
    play(found, recovered)
    assert needed <= found.accepted <= 1.3 * needed + 1
    assert recovered(found.accepted) >= found.target


def test_a_field_that_cannot_lose_primitives_keeps_them() -> None:
    found = search()
    play(found, lambda count: 30.01 if count == 1000 else 20.0)
    assert (found.accepted, found.rejected) == (1000, 5)
    assert 0 < found.steps_lost <= 5 * 4, "a few evaluations each"


def test_a_field_that_loses_no_quality_is_cut_to_the_least() -> None:
    found = search()
    cuts = play(found, lambda _: 40.0, least=17)
    assert found.accepted == cuts[-1] == 17
    assert cuts[:3] == [500, 250, 125]
    assert found.next_count(40.0, 17, 3) is None


def cut_in_half() -> SearchProgress:
    found = search()
    found.cut(30.1, 500, step=100)
    return found


def test_a_cut_is_accepted_once_it_reaches_the_target() -> None:
    assert verdicts(cut_in_half(), 29.0, 29.99, 30.0) == ["waiting", "waiting", "accepted"]


def test_a_cut_may_take_as_long_as_it_is_predicted_to_recover() -> None:
    slowly = [28.0 + 0.5 * math.log2(1 + look) for look in range(15)]
    assert verdicts(cut_in_half(), *slowly, 30.0, left=1000) == ["waiting"] * 15 + ["accepted"]
    found = cut_in_half()
    assert verdicts(found, *slowly, left=1000) == ["waiting"] * 15
    assert found.judge(29.99, 260, 0, patience=4) == "rejected", "time is up"
    assert found.steps_lost == 160


def test_a_cut_is_taken_back_at_once_if_the_whole_predicted_gain_is_too_small() -> None:
    found = cut_in_half()
    assert verdicts(found, 28.0, 29.0, left=15) == ["waiting", "rejected"]  # 1 dB a doubling, and 0.8 to come
    assert (found.rejected, found.steps_lost, found.accepted) == (1, 20, 1000)
    assert found.slope == pytest.approx(0.1 + 1.0 - 0.5 * math.log2(35 / 20)), "by the prediction"
    assert verdicts(cut_in_half(), 28.0, 29.0, left=18) == ["waiting", "waiting"], (
        "0.926 may be enough: evaluations differ by 0.1"
    )


def test_after_some_patience_half_of_the_predicted_gain_must_suffice() -> None:
    values = [28.0, 29.0, 28.0 + math.log2(3)]  # a line: 1 dB a doubling
    assert verdicts(cut_in_half(), *values, left=20, patience=3) == ["waiting", "waiting", "rejected"]
    assert verdicts(cut_in_half(), *values, left=20, patience=4) == ["waiting", "waiting", "waiting"]
    assert verdicts(cut_in_half(), *values, left=30, patience=3) == ["waiting", "waiting", "waiting"]


def test_the_prediction_is_a_line_over_the_logarithm_of_the_steps() -> None:
    found = cut_in_half()
    verdicts(found, 28.0, 29.0, 28.0 + math.log2(3))
    assert found.predicted(0, 1.0) == pytest.approx(28.0 + math.log2(3))
    assert found.predicted(30, 1.0) == pytest.approx(29.0 + math.log2(3))
    assert found.predicted(30, 0.5) == pytest.approx(28.5 + math.log2(3))
    falling = cut_in_half()
    verdicts(falling, 29.0, 28.0)
    assert falling.predicted(20, 0.5) == pytest.approx(27.0), "a loss is counted whole"


def rest(found: SearchProgress, *values: float) -> SearchProgress:
    for psnr in values:
        assert found.judge(psnr, 10, 100, patience=3) == "no cut"
    return found


def test_a_field_that_falls_below_the_target_by_itself_gets_a_lower_one() -> None:
    found = rest(search(), 29.8, 29.9, 29.8, 29.85)
    assert (found.aim, found.next_count(29.85, 1, 3)) == (30.0, None), "it may still gain"
    rest(found, 29.82)
    assert found.aim == pytest.approx(29.77), "less by half of the tolerated drop"
    found.slope = 1.0
    assert found.next_count(29.82, 1, 3) == int(1000 * 0.5**SHALLOWEST)
    found.cut(29.82, 901, step=100)
    assert found.before_cut == pytest.approx(29.82)
    assert verdicts(found, 29.7, 29.78) == ["waiting", "accepted"]
    assert found.next_count(30.02, 1, 3) == int(901 * 0.5**0.5), "by its margin"
    rest(found, 30.0)
    assert found.aim == 30.0, "the target is in reach again"


def test_a_field_that_gains_no_more_gets_the_smallest_cut() -> None:
    found = rest(search(), 30.02, 30.05, 30.01, 30.02)
    found.slope = 1.0
    assert found.next_count(30.02, 1, 3) is None
    assert rest(found, 30.03).next_count(30.03, 1, 3) == int(1000 * 0.5**SHALLOWEST)
    assert rest(found, 30.06).next_count(30.06, 1, 3) is None, "it gains again"


@pytest.mark.parametrize("values", [(29.8, 29.9, 29.85, 29.87, 29.91, 29.9, 29.9), (30.2, 30.1, 30.1, 30.1, 30.1)])
def test_a_field_that_gains_or_has_reached_the_target_keeps_it(values: tuple[float, ...]) -> None:
    assert rest(search(), *values).aim == 30.0


def test_a_head_without_an_accepted_cut_does_not_lower_the_target() -> None:
    found = search()
    found.begin("head", 1000)
    assert rest(found, *[29.5] * 9).aim == 30.0
    found.cuts = 1
    assert rest(found, 29.5).aim == pytest.approx(29.45)
    found.begin("head", 500)
    assert (found.aim, found.stuck) == (30.0, 0)


def test_an_image_that_is_not_finite_is_no_success() -> None:
    found = cut_in_half()
    assert verdicts(found, NO_IMAGE) == ["rejected"]
    assert (found.accepted, found.failed) == (1000, 500)
    assert found.slope == 0, "it does not measure the cost of a halving"
    assert found.next_count(30.1, 1, 3) == int(1000 * 0.5**0.5)
    assert SearchProgress.from_state(asdict(found)).trail == [[10, NO_IMAGE]]


def test_a_field_without_a_finite_image_is_trained_and_not_cut() -> None:
    found = rest(search(), 30.1, *[NO_IMAGE] * 9)
    assert (found.stuck, found.aim, found.next_count(NO_IMAGE, 1, 3)) == (9, 30.0, None)


def test_the_sh_degree_stays_if_no_degree_renders_a_finite_image() -> None:
    found = SearchProgress(reference=30.0, degrees={"3": NO_IMAGE})
    assert (found.next_degree(3, 0.1), found.lowest_degree(3, 0.1)) == (None, 3)


def test_cuts_approach_a_rejected_count_from_above() -> None:
    found = search()
    found.cut(30.1, 500, step=0)
    assert found.judge(29.0, 1, 0, patience=4) == "rejected"
    assert found.next_count(40.0, 1, 3) == int(1000 * 0.5**0.5)
    found.accepted = 520
    assert found.next_count(40.0, 1, 3) == found.next_count(30.5, 1, 3) == int(520 * 0.5**SHALLOWEST)
    found.begin("head", 520)
    assert found.next_count(40.0, 1, 3) == 260


def test_a_rejected_count_is_forgotten_once_a_field_as_small_is_accepted() -> None:
    found = search()
    found.cut(30.1, 500, step=0)
    assert found.judge(29.0, 1, 0, patience=4) == "rejected"
    found.cut(30.5, 501, step=2)
    assert (found.judge(30.5, 3, 50, patience=4), found.failed) == ("accepted", 500)
    found.cut(30.5, 490, step=4)
    assert (found.judge(30.5, 5, 50, patience=4), found.failed) == ("accepted", 0)
    found.slope = 0.5
    assert found.next_count(30.5, 1, 3) == 245, "by the cost of a halving alone"


def test_the_depth_of_a_cut_follows_from_the_cost_of_the_last_one() -> None:
    found = search()
    assert found.next_count(30.0, 1, 3) == round(1000 * 0.5**DEEPEST)
    found.cut(31.0, 500, step=0)
    assert found.judge(30.4, 1, 50, patience=4) == "accepted"
    assert found.slope == pytest.approx(0.6)
    assert found.next_count(30.3, 1, 3) == int(500 * 0.5**0.5)
    assert found.next_count(30.05, 1, 3) is None
    assert search().next_count(29.99, 1, 3) is None, "a field below the target is trained, not cut"
    assert found.judge(30.05, 2, 50, patience=4) == "no cut"
    found.cut(30.3, 353, step=3)
    assert found.judge(30.3, 4, 50, patience=4) == "accepted"
    assert found.slope == pytest.approx(0.3), "a lucky cut does not make the next one cheap"
    assert (found.cuts, found.rejected) == (2, 0)


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
    found, top, tried = SearchProgress(), max(values), []
    while (degree := found.next_degree(top, 0.1)) is not None:
        tried.append(degree)
        found.degrees[str(degree)] = values[degree]
    assert tried == order
    assert found.lowest_degree(top, 0.1) == lowest


def test_state_goes_through_a_checkpoint() -> None:
    found = search()
    found.cut(30.1, 500, step=100)
    found.judge(29.0, 110, 50, patience=4)
    found.lowered, found.best = 29.0, 29.1
    found.curve.append(Point(1, "field", 10, 100, 30.0, "waiting", 5))
    assert SearchProgress.from_state(asdict(found)) == found
    assert json.loads(json.dumps(asdict(found)))["curve"][0]["primitives"] == 10


@pytest.mark.parametrize("name", ["target", "trail", "stuck"])
def test_a_state_that_lacks_an_entry_is_refused(name: str) -> None:
    state = asdict(search())
    del state[name]
    with pytest.raises(CheckpointError, match="other entries"):
        SearchProgress.from_state(state)


@pytest.mark.parametrize(
    "change",
    [
        {"phase": "lunch"},
        {"accepted": "many"},
        {"degree": 5},
        {"degree": -2},
        {"num_features": 1025},
        {"curve": [{"step": 1}]},
        {"new": 1},
        {"cuts": 0.5},
        {"trail": [[10, 30.0, 1]]},
        {"trail": [[0, 30.0]]},
        {"trail": [[10, math.inf]]},
        {"trail": [3]},
        {"trail": 3},
        {"trail": [["a", "b"]]},
    ],
)
def test_a_foreign_state_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(CheckpointError, match="damaged budget search"):
        SearchProgress.from_state({**asdict(search()), **change})


def test_states_at_the_limits_are_accepted() -> None:
    for change in ({"degree": 4}, {"degree": -1}, {"num_features": 1024}, {"num_features": -1}):
        SearchProgress.from_state({**asdict(search()), **change})


def test_a_new_phase_counts_anew_and_remembers_the_cost_of_a_halving() -> None:
    found = SearchProgress(
        reference=30.1, target=30.0, rejected=2, failed=7, cuts=3, looks=5, stuck=4, lowered=29.0, best=30.0, slope=0.2
    )
    found.begin("head", 400)
    assert (found.rejected, found.failed, found.cuts, found.looks, found.stuck) == (0, 0, 0, 0, 0)
    assert math.isnan(found.lowered)
    assert math.isnan(found.best)
    assert (found.phase, found.accepted, found.trying, found.slope) == ("head", 400, False, 0.2)
