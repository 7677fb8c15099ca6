"""Whole runs that decide how many primitives they keep, on a scene of a few pixels."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.engine.trainer import Trainer
from trial_runs import PRUNE_AT, STEPS, same, tidy, tiny_run, tiny_scene

from sundae_ns.evaluation.count_curve import read_count_curve
from sundae_ns.pruning import kept_count
from sundae_ns.training.heldout import HeldOutQuality
from sundae_ns.training.pruning_config import PruningConfig
from sundae_ns.training.trials import count as count_trials
from sundae_ns.training.trials import engine

VIEWS = 40
TRIAL, HEAD_TRIAL = 2, 5
"""Steps of a trial of a count and of the head: a fiftieth and a twentieth of so short a run."""
DECIDED = PRUNE_AT + len(count_trials.SHARES) * TRIAL
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
        real = engine.measure_heldout

        def measured(run: Any, **options: Any) -> list[HeldOutQuality]:
            (trials,) = (one for one in extensions_of(run) if one.name == "count")
            if trials.progress.phase != "trials":
                return real(run, **options)
            share = count_trials.SHARES[len(trials.progress.counts) - 1]
            found, similar = 30 - losses[share], 0.9 - 0.03 * losses[share]
            if trials.progress.tries_head:
                assert run.state.head_enabled == (len(trials.progress.head) == 1)
                assert run.source.total == kept_count(0.1, trials.progress.full)
                found, similar = 30 + head * len(trials.progress.head), 0.9
            return [HeldOutQuality(100, found, similar, found) for _ in run.heldout_views()]

        monkeypatch.setattr(engine, "measure_heldout", measured)

    return fix


def extensions_of(run: Any) -> list[Any]:
    return list(run.model.extensions)


def record_of(trainer: Trainer) -> dict[str, Any]:
    return dict(json.loads((trainer.base_dir / "curve.json").read_text()))


def head_steps(model: Any) -> float:
    """Steps in which the head was trained, without those that were taken back."""
    (engine,) = (saved["engine"] for one in model.extensions if "engine" in (saved := one.state_dict()))
    return float(model.state.schedule_step - model.state.head_starts_at - engine["taken_back"])


def watch(trainer: Trainer) -> tuple[list[int], dict[str, torch.Tensor]]:
    """Collects the views that are served by step, and the field before the trials and before the prune."""
    manager, served, fields = trainer.pipeline.datamanager, [], {}
    model: Any = trainer.pipeline.model
    trials, pruning = ({one.name: one for one in model.extensions}[name] for name in ("count", "pruning"))
    serve, begin, prune = manager.view_of_step, trials._begin, pruning.after_step

    def view_of_step(step: int) -> int:
        served.append(serve(step))
        return served[-1]

    def began(run: Any) -> None:
        fields["before"] = model.gauss_params["means"].detach().clone()
        begin(run)

    def pruned(run: Any) -> None:
        if run.state.schedule_step >= PRUNE_AT and trials.progress.phase == "done" and "after" not in fields:
            fields["after"] = model.gauss_params["means"].detach().clone()
        prune(run)

    manager.view_of_step, trials._begin, pruning.after_step = view_of_step, began, pruned
    return served, fields


LEVEL = {1.0: 0.0, 0.4: 0.0, 0.2: 0.05, 0.1: 1.0, 0.05: 2.0, 0.025: 3.0}
"""Losses that level off: between a tenth and a fifth of the primitives are enough."""


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


@pytest.mark.parametrize(("gain", "decision"), [(4.0, "head"), (0.2, "plain"), (-0.3, "plain")])
def test_a_head_that_gains_at_a_tenth_is_kept_with_more(make: Make, judge: Any, gain: float, decision: str) -> None:
    """If it gains enough for its bytes, which are several times those of this field."""
    judge(LEVEL, gain)
    trainer = make(head="auto")
    model: Any = trainer.pipeline.model
    fresh = {name: value.clone() for name, value in model.state.head.state_dict().items()}
    (trials,) = (one for one in model.extensions if one.name == "trials")
    settle, found = trials._settle, {}

    def settled(*words: Any) -> None:
        found.update({name: value.clone() for name, value in model.state.head.state_dict().items()})
        settle(*words)

    trials._settle = settled
    trainer.train()
    record, verdict = record_of(trainer), json.loads((trainer.base_dir / "trials.json").read_text())
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
    judge(dict.fromkeys(count_trials.SHARES, 0.0), 0.2)
    trainer = make(head="auto")
    trainer.train()
    record, verdict = record_of(trainer), json.loads((trainer.base_dir / "trials.json").read_text())
    assert record["chosen"] <= record["full"] / 10
    assert "head" not in record
    assert verdict["step"] > record["step"]
    assert not set(record["held_out_views"]) & set(verdict["held_out_views"])


@pytest.mark.parametrize(
    ("head", "stops"),
    [("residual", (10, 45, DECIDED + 3)), ("auto", (45, DECIDED + 3, DECIDED + HEAD_TRIAL + 3))],
)
def test_a_resumed_run_takes_the_same_decision_bit_for_bit(
    make: Make, judge: Any, head: str, stops: tuple[int, ...]
) -> None:
    """Before and in the trials of counts, in those of the head, and after the decision."""
    # All counts are tried, and more than a tenth is chosen, so that the head has its trials.
    judge({1.0: 0.0, 0.4: 0.0, 0.2: 0.05, 0.1: 0.45, 0.05: 0.65, 0.025: 0.8}, 0.2)
    whole = make(head=head, name="whole", save_every=math.gcd(*stops))
    whole.train()
    for stop in stops:
        more = STEPS - stop - 1
        name = f"from {stop}"
        resumed = make(head=head, name=name, load_dir=whole.checkpoint_dir, load_step=stop, max_num_iterations=more)
        resumed.train()
        last = f"step-{STEPS - 1:09d}.ckpt"
        folders = (whole.checkpoint_dir, resumed.checkpoint_dir)
        a, b = (torch.load(folder / last, map_location="cpu", weights_only=True) for folder in folders)
        for part in ("pipeline", "optimizers", "schedulers"):
            same(a[part], b[part])
        if stop < record_of(whole)["step"]:
            assert record_of(whole) == record_of(resumed)
    if head == "auto":
        assert record_of(whole)["step"] == DECIDED + 2 * HEAD_TRIAL


def test_a_head_in_any_case_rests_during_the_trials_and_counts_its_own_steps(make: Make, judge: Any) -> None:
    judge(LEVEL)
    trainer = make(head="residual")
    enabled: dict[int, bool] = {}
    model: Any = trainer.pipeline.model
    real = model.extensions[-1].after_step

    def after_step(run: Any) -> None:
        enabled[run.state.step] = run.state.head_enabled
        real(run)

    model.extensions[-1].after_step = after_step
    trainer.train()
    decided = record_of(trainer)["step"]
    assert not any(enabled[step] for step in range(decided))
    assert all(enabled[step] for step in range(decided + 1, STEPS))
    assert head_steps(model) == STEPS - 1 - decided
    assert not model.state.provisional


@pytest.mark.parametrize(
    ("pruning", "kept"),
    [({"max_primitives": 9}, 9), ({"max_bytes": 1}, 1), ({"max_drop": 20.0}, 5)],  # 5: 2.5% of 200
)
def test_a_budget_works_on_the_same_curve(make: Make, judge: Any, pruning: dict[str, Any], kept: int) -> None:
    judge(LEVEL)
    trainer = make(pruning=pruning)
    trainer.train()
    assert trainer.pipeline.model.num_points == record_of(trainer)["chosen"]  # type: ignore[union-attr]
    assert abs(record_of(trainer)["chosen"] - kept) <= (1 if pruning.get("max_drop") else 0)


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
    views = options.pop("views", None)
    trainer = make(**options, **({} if views is None else {"data": tiny_scene(tmp_path, views)}))
    trainer.train()
    assert trainer.pipeline.model.num_points == 20  # type: ignore[union-attr]
    said = " ".join(capsys.readouterr().out.split())
    assert said.count(f"pruning keeps 10% of the primitives: {reason}") == 1
    assert not (trainer.base_dir / "curve.json").exists()


def test_a_number_that_the_user_gives_is_kept_exactly(make: Make) -> None:
    trainer = make(pruning={"target_primitives": 33})
    trainer.train()
    assert trainer.pipeline.model.num_points == 33  # type: ignore[union-attr]
    assert not (trainer.base_dir / "curve.json").exists()
