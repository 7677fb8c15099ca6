"""Whole runs that decide how many Gaussians they keep, on a scene of a few pixels."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.engine.trainer import Trainer
from trial_runs import PRUNE_AT, STEPS, records_of, served_views, tidy, tiny_run, tiny_scene, trials_of

from sundae_ns.pruning.rule import kept_count
from sundae_ns.train import trials
from sundae_ns.train.choice import HeldOutQuality
from sundae_ns.train.curve import read_count_curve
from sundae_ns.train.pruning import PruningConfig

VIEWS = 40
TRIAL, HEAD_TRIAL = 2, 5
"""Steps of a trial of a count and of the head: a fiftieth and a twentieth of so short a run."""
DECIDED = PRUNE_AT + len(trials.SHARES) * TRIAL
"""Step of the decision if all counts are tried."""
Make = Callable[..., Trainer]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_scene(tmp_path_factory.mktemp("scenes"), VIEWS)


@pytest.fixture
def make(scene: Path, tmp_path: Path) -> Iterator[Make]:
    def made(
        *, head: str = "off", data: Path = scene, pruning: dict[str, Any] | None = None, **options: Any
    ) -> Trainer:
        def change(config: Any) -> None:
            config.pipeline.model.head.mode, config.pipeline.model.dense_start_views = head, 0
            config.pipeline.model.pruning = PruningConfig(keep_ratio=None, prune_at=PRUNE_AT)
            for name, value in (pruning or {}).items():
                setattr(config.pipeline.model.pruning, name, value)

        return tiny_run(data, tmp_path, change=change, **options)

    yield made
    tidy()


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Fixes what the counts lose against the full field on every held-out view, PSNR in dB by share and SSIM in
    proportion, and what a head gains at a tenth."""

    def fix(losses: dict[float, float], head: float = 0.0) -> None:
        real = trials.measure_heldout

        def measured(run: Any, **options: Any) -> list[HeldOutQuality]:
            progress = trials_of(run.model).progress
            if progress.stage not in ("count", "tenth"):
                return real(run, **options)
            tenth = progress.of("tenth")
            if progress.stage == "tenth":
                assert run.state.head_enabled == (len(tenth) == 1)
                assert run.source.total == kept_count(0.1, progress.full)
                found, similar = 30 + head * len(tenth), 0.9
            else:
                loss = losses[trials.SHARES[len(progress.of("count"))]]
                found, similar = 30 - loss, 0.9 - 0.03 * loss
            return [HeldOutQuality(100, found, similar, found) for _ in run.heldout_views()]

        monkeypatch.setattr(trials, "measure_heldout", measured)

    return fix


def record_of(trainer: Trainer) -> dict[str, Any]:
    return dict(records_of(trainer)["count"])


def head_steps(model: Any) -> float:
    """Steps in which the head was trained, without those that were taken back."""
    return float(model.state.schedule_step - model.state.head_starts_at - trials_of(model).taken_back)


def watch(trainer: Trainer) -> tuple[list[int], dict[str, torch.Tensor]]:
    """Collects the views that are served by step, and the field before the trials and before the prune."""
    served: list[int] = served_views(trainer)
    fields: dict[str, torch.Tensor] = {}
    model: Any = trainer.pipeline.model
    deciding, pruning = ({one.name: one for one in model.train_callbacks}[name] for name in ("trials", "pruning"))
    begin, prune = deciding._begin_counts, pruning.after_step

    def began(run: Any) -> None:
        fields["before"] = model.gauss_params["means"].detach().clone()
        begin(run)

    def pruned(run: Any) -> None:
        if run.state.schedule_step >= PRUNE_AT and "count" in deciding.progress.chosen and "after" not in fields:
            fields["after"] = model.gauss_params["means"].detach().clone()
        prune(run)

    deciding._begin_counts, pruning.after_step = began, pruned
    return served, fields


LEVEL = {1.0: 0.0, 0.4: 0.0, 0.2: 0.05, 0.1: 1.0, 0.05: 2.0, 0.025: 3.0}
"""Losses that level off: between a tenth and a fifth of the Gaussians are enough."""


def test_trials_choose_the_count_and_leave_nothing_else_behind(make: Make, judge: Any) -> None:
    judge(LEVEL)
    trainer = make(head="auto")
    served, fields = watch(trainer)
    trainer.train()
    record, model = record_of(trainer), trainer.pipeline.model
    full, chosen, held = record["full"], record["chosen"], set(record["held_out_views"])
    assert full / 10 < chosen <= full / 5
    assert model.num_points == chosen  # type: ignore[union-attr]
    # A count that loses a decibel is clearly too few, so smaller ones are not tried.
    assert [round(one["count"] / full, 2) for one in record["curve"]] == [1.0, 0.4, 0.2, 0.1]
    assert record["step"] == PRUNE_AT + 4 * TRIAL + 2 * HEAD_TRIAL
    assert [len(one["measured"]) for one in record["curve"]] == [len(held)] * 4
    assert all(one["bytes"] > 0 for one in record["curve"])
    assert torch.equal(fields["before"], fields["after"])
    # Held out from the first step.
    assert len(held) == VIEWS // 8
    assert not held & set(served[: PRUNE_AT + 4 * TRIAL])
    assert held & set(served[record["step"] + 1 :])
    points = read_count_curve(trainer.base_dir)
    assert points is not None
    assert [point.count for point in points.points] == [one["count"] for one in record["curve"]]
    (prune,) = json.loads((trainer.base_dir / "prune.json").read_text())
    assert (prune["before"], prune["after"], prune["step"]) == (full, chosen, record["step"])


@pytest.mark.parametrize(("gain", "decision"), [(4.0, "head"), (0.2, "plain")])
def test_a_head_that_gains_at_a_tenth_is_kept_with_more(make: Make, judge: Any, gain: float, decision: str) -> None:
    """If it gains enough for its bytes, which are several times those of this field."""
    judge(LEVEL, gain)
    trainer = make(head="auto")
    model: Any = trainer.pipeline.model
    fresh = {name: value.clone() for name, value in model.state.head.state_dict().items()}
    deciding = trials_of(model)
    settle, found = deciding._finish_with, {}

    def settled(*words: Any) -> None:
        found.update({name: value.clone() for name, value in model.state.head.state_dict().items()})
        settle(*words)

    deciding._finish_with = settled
    trainer.train()
    record, verdict = record_of(trainer), records_of(trainer)["head"]
    assert (record["head"]["pays"], verdict["decision"]) == (decision == "head", decision)
    assert record["head"]["head"]["psnr"] - record["head"]["plain"]["psnr"] == pytest.approx(gain)
    assert verdict["step"] == record["step"]
    assert (model.state.head is None) == (decision == "plain")
    # What the head learnt on a tenth does not fit the chosen field.
    assert all(torch.equal(fresh[name], found[name]) for name in fresh)
    if decision == "head":
        assert any(not torch.equal(fresh[name], value) for name, value in model.state.head.state_dict().items())
        assert head_steps(model) == STEPS - 1 - record["step"]
        assert not model.state.provisional


def test_where_a_tenth_is_kept_the_head_has_its_usual_trials(make: Make, judge: Any) -> None:
    judge(dict.fromkeys(trials.SHARES, 0.0), 0.2)
    trainer = make(head="auto")
    trainer.train()
    record, verdict = record_of(trainer), records_of(trainer)["head"]
    assert record["chosen"] <= record["full"] / 10
    assert "head" not in record
    assert verdict["step"] > record["step"]
    assert not set(record["held_out_views"]) & set(verdict["held_out_views"])


def test_a_head_in_any_case_rests_during_the_trials_and_counts_its_own_steps(make: Make, judge: Any) -> None:
    judge(LEVEL)
    trainer = make(head="residual")
    enabled: dict[int, bool] = {}
    model: Any = trainer.pipeline.model
    real = model.train_callbacks[-1].after_step

    def after_step(run: Any) -> None:
        enabled[run.state.step] = run.state.head_enabled
        real(run)

    model.train_callbacks[-1].after_step = after_step
    trainer.train()
    decided = record_of(trainer)["step"]
    assert not any(enabled[step] for step in range(decided))
    assert all(enabled[step] for step in range(decided + 1, STEPS))
    assert head_steps(model) == STEPS - 1 - decided
    assert not model.state.provisional


def test_a_budget_works_on_the_same_curve(make: Make, judge: Any) -> None:
    judge(LEVEL)
    trainer = make(pruning={"max_gaussians": 9})
    trainer.train()
    assert trainer.pipeline.model.num_points == record_of(trainer)["chosen"] == 9  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"pruning": {"prune_at": 75}}, "the steps after the prune are too few"),
        ({"views": 16}, "16 training views are too few"),
    ],
)
def test_where_trials_cannot_decide_a_tenth_stays_and_one_line_says_so(
    make: Make, tmp_path: Path, options: dict[str, Any], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    cameras = options.pop("views", None)
    trainer = make(**options, **({} if cameras is None else {"data": tiny_scene(tmp_path, cameras)}))
    trainer.train()
    assert trainer.pipeline.model.num_points == 20  # type: ignore[union-attr]
    said = " ".join(capsys.readouterr().out.split())
    assert said.count(f"pruning keeps 10% of the Gaussians: {reason}") == 1
    assert "count" not in records_of(trainer)
