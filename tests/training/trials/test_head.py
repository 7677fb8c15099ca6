"""The plan of the trials that decide how a field is finished, their verdict, and the removal of a head."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import pytest
from models import Training

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.errors import CheckpointError
from sundae_ns.model import SundaeModel
from sundae_ns.training.trials.engine import Trial
from sundae_ns.training.trials.head import CANDIDATES, MOST_HELD_OUT, HeadTrialProgress, HeadTrials, plan_trials

Build = Callable[..., SundaeModel]
SIZES = [100, 110, 120]
"""Bytes of the candidates."""


@pytest.mark.parametrize(("views", "held_out"), [(12, 2), (16, 2), (43, 5), (73, 9), (105, 13), (255, 16), (2000, 16)])
def test_an_eighth_of_the_views_is_held_out_within_limits(views: int, held_out: int) -> None:
    trials = plan_trials(range(views), 30000)
    assert trials.length == 1200
    (fold,) = trials.folds
    assert len(set(fold)) == held_out <= MOST_HELD_OUT
    # Even gaps: no stretch of the capture goes unjudged.
    gaps = [b - a for a, b in zip(fold, fold[1:])]
    assert max(gaps) - min(gaps) <= 1
    assert fold[0] >= 1
    assert fold[-1] < views - 1


@pytest.mark.parametrize("views", [6, 9, 11])
def test_with_few_views_two_are_held_out_in_turn(views: int) -> None:
    trials = plan_trials([10 * i for i in range(views)], 30000)
    assert trials.length == 600
    assert [len(fold) for fold in trials.folds] == [1, 1]
    assert len(set(trials.views)) == 2
    assert all(index % 10 == 0 for index in trials.views)


@pytest.mark.parametrize("views", [6, 12, 255])
@pytest.mark.parametrize("steps", [1000, 7000, 18000, 30000, 60000])
def test_deciding_costs_at_most_a_tenth_of_the_steps(views: int, steps: int) -> None:
    trials = plan_trials(range(views), steps)
    # The trial of one candidate continues.
    assert (len(CANDIDATES) * len(trials.folds) - 1) * trials.length <= 0.1 * steps


@pytest.mark.parametrize(("steps", "length"), [(7000, 350), (18000, 900), (30000, 1200), (60000, 2400)])
def test_short_runs_have_longer_trials_for_their_length(steps: int, length: int) -> None:
    """In a trial of 720 steps, 500 of them a rise, a head on bonsai showed 0.08 of the 1.8 dB that it gains."""
    assert plan_trials(range(255), steps).length == length


def test_the_mode_auto_adds_a_trial_and_the_others_do_not(build: Build) -> None:
    assert "trials" in {extension.name for extension in build(head={"mode": "auto"}).extensions}
    for mode in ("residual", "features", "off"):
        assert "trials" not in {extension.name for extension in build(head={"mode": mode}).extensions}
    names = [extension.name for extension in build(head={"mode": "auto"}, pruning={"keep_ratio": None}).extensions]
    # Trials of counts come before the prune, those of the head after it.
    assert names.index("count") < names.index("pruning") < names.index("trials")
    assert "count" not in {extension.name for extension in build().extensions}


def test_an_undecided_head_is_residual_and_disabled(build: Build) -> None:
    model = build(head={"mode": "auto"})
    model.step = 10**6
    assert model.head is not None
    assert model.head.config.mode == "residual"
    assert not model.state.head_enabled


def test_a_head_is_undecided_by_default_and_then_residual() -> None:
    assert HeadConfig().mode == "auto"
    assert CompensationHead(HeadConfig()).config.mode == "residual"


def test_a_removed_head_leaves_no_values_and_no_moments(build: Build) -> None:
    model = build(head={"mode": "residual"})
    training = Training(model)
    for step in range(3, 6):
        training.step(step)
    training.step(6)
    assert model.state.head_enabled
    assert training.optimizers.optimizers["compensation"].state
    features = model.gauss_params["features"]
    model.state.remove_head()
    assert model.head is None
    assert model.gauss_params["features"] is features
    assert features.numel() == 0
    assert not training.optimizers.optimizers["compensation"].state
    assert not training.optimizers.optimizers["features"].state
    before = model.gauss_params["means"].detach().clone()
    training.step(7)
    assert not model.gauss_params["means"].detach().equal(before)


def test_a_checkpoint_without_a_decision_names_the_option(build: Build) -> None:
    model = build(head={"mode": "auto"})
    (trial,) = (extension for extension in model.extensions if isinstance(extension, HeadTrials))
    with pytest.raises(CheckpointError, match=r"--pipeline.model.head.mode"):
        trial.prepare_loading(model.state, {})


def test_only_trials_do_without_mirrored_images(build: Build) -> None:
    """They are too short to see what these bring; a run that resumes in a trial goes on with it."""
    model = build(head={"mode": "auto"})
    (trial,) = (extension for extension in model.extensions if isinstance(extension, HeadTrials))
    for phase, mirrored in (("trials", False), ("done", True)):
        progress = HeadTrialProgress(phase=phase, decision="head" if mirrored else "", measured=[[]])
        engine = {} if mirrored else {"trial": asdict(Trial(10, counts=False)), "kept": {"start": {}, "plain": {}}}
        trial.load_state_dict(model.state, {"numbers": asdict(progress), "engine": engine})
        model.step = 10**6
        assert model.state.head_enabled
        assert model.resolution(model.step).mirror == mirrored


@pytest.mark.parametrize(
    ("head", "features", "best"),
    [
        ((0.09, 0.01), None, "plain"),
        ((0.2, 0.01), (0.29, 0.02), "head"),
        ((0.2, 0.01), (0.31, 0.01), "features"),
        ((0.2, 0.01), (0.9, 0.009), "head"),
        ((0.5, -0.001), None, "plain"),
        ((0.5, 0.0), (0.9, 0.0), "features"),
        ((float("nan"), 0.01), None, "plain"),
        ((float("inf"), 0.01), None, "plain"),
        ((0.5, 0.01), (0.9, float("nan")), "head"),
    ],
)
def test_a_candidate_must_gain_over_the_cheaper_ones_and_must_not_lose_ssim(
    head: tuple[float, float], features: tuple[float, float] | None, best: str
) -> None:
    # Two folds; the second view has more pixels and is harder.
    measured = [
        [[float(pixels), decibels + gain[0], 0.7 + gain[1]]]
        for gain in ((0.0, 0.0), head, *([] if features is None else [features]))
        for pixels, decibels in ((100, 25.0), (300, 20.0))
    ]
    progress = HeadTrialProgress(folds=2, measured=measured, bytes=SIZES)
    assert progress.best == best
    assert progress.tried == CANDIDATES[: 2 if features is None else 3]


def test_a_candidate_counts_when_all_its_folds_have_ended() -> None:
    plain, head = [[10.0, 20.0, 0.5]], [[10.0, 30.0, 0.9]]
    assert HeadTrialProgress(folds=2, bytes=SIZES, measured=[plain, plain, head]).best == "plain"
    assert HeadTrialProgress(folds=2, bytes=SIZES, measured=[plain, plain, head, head]).best == "head"


@pytest.mark.parametrize(("gain", "size", "best"), [(0.41, 200, "head"), (0.39, 200, "plain"), (0.39, 190, "head")])
def test_a_candidate_that_takes_more_bytes_must_gain_more(gain: float, size: int, best: str) -> None:
    measured = [[[10.0, 20.0, 0.5]], [[10.0, 20.0 + gain, 0.5]]]
    assert HeadTrialProgress(bytes=[100, size, 400], measured=measured).best == best


def test_views_count_by_their_pixels() -> None:
    # A gain of 1 dB on few pixels does not outweigh a loss on many.
    plain, head = [[10.0, 20.0, 0.5], [990.0, 20.0, 0.5]], [[10.0, 21.0, 0.6], [990.0, 19.99, 0.6]]
    assert HeadTrialProgress(bytes=SIZES, measured=[plain, head]).best == "plain"


def earlier(phase: str, stopping: str) -> dict[str, dict[str, Any]]:
    """States as versions before the engine saved them."""
    numbers: dict[str, Any] = {
        "phase": phase,
        "decision": "head" if phase == "done" else "",
        "reason": "",
        "steps": 1000,
        "trial": 1,
    }
    numbers |= {"folds": 1, "bytes": SIZES, "began": 40, "measured": [[[10.0, 20.0, 0.5]]], "undone": 7}
    watch = {"phase": stopping, "began": 50, "ends": 90, "measured": [[0.1, 20.0, 0.5]]}
    mean: dict[str, Any] = {"mean": {}, "count": 0}
    return {
        "trials": {"numbers": numbers, "start": None, "ends": {}, **mean},
        "stopping": {"numbers": watch, "start": None, **mean},
    }


def load(model: SundaeModel, saved: dict[str, dict[str, Any]]) -> None:
    for extension in model.extensions:
        extension.load_state_dict(model.state, saved.get(extension.name, {}))


@pytest.mark.parametrize(("stopping", "trains"), [("done", True), ("resting", False)])
def test_a_decision_of_an_earlier_version_is_loaded(build: Build, stopping: str, trains: bool) -> None:
    model = build(head={"mode": "auto"})
    saved = earlier("done", stopping)
    load(model, saved)
    model.step = 100
    assert model.state.head_enabled
    (trials,) = (extension for extension in model.extensions if extension.name == "trials")
    assert trials.state_dict()["engine"]["taken_back"] == 7
    assert all(extension.trains(model.state) for extension in model.extensions) == trains
    model.step = 1000
    assert all(extension.trains(model.state) for extension in model.extensions)


@pytest.mark.parametrize(("phase", "stopping"), [("trials", "before"), ("done", "watching"), ("done", "repeating")])
def test_trials_of_an_earlier_version_are_refused_in_one_line(build: Build, phase: str, stopping: str) -> None:
    model, saved = build(head={"mode": "auto"}), earlier(phase, stopping)
    with pytest.raises(CheckpointError, match="lacks a field") as raised:
        load(model, saved)
    assert "\n" not in str(raised.value)
