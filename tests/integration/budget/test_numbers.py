"""A search among numbers that are none: heads, primitives and pictures that broke, and what fails of itself."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
import torch
from budget_runs import PRUNE_AT, Make, Run
from torch import Tensor

from sundae_ns.compensation import HeadConfig
from sundae_ns.errors import DataError
from sundae_ns.training import budget
from sundae_ns.training.budget import Budget
from sundae_ns.training.budget.run import Run as Searched
from sundae_ns.training.budget.search import NO_PICTURE, Search


def spoil(monkeypatch: pytest.MonkeyPatch, when: Callable[[Searched], bool], values: Callable[[Any], Tensor]) -> None:
    """Make some numbers of a model NaN after the first step of training at which it is time."""
    after_step, done = Budget.after_step, []

    def spoiled(self: Budget, model: Any, attributes: Any) -> None:
        if not done and when(Searched.of(model, attributes)):
            values(model).data.fill_(torch.nan)
            done.append(model.step)
        after_step(self, model, attributes)

    monkeypatch.setattr(Budget, "after_step", spoiled)


def about_to_look(run: Searched, phase: str, *, trying: bool) -> bool:
    found: Budget = run.model.budget  # type: ignore[assignment]
    return (found.search.phase, found.search.trying) == (phase, trying) and found._look_is_due(run)


@pytest.mark.parametrize("trying", [False, True])
def test_a_head_that_is_no_longer_numbers_is_taken_back(
    make: Make, small_head: dict[str, Any], monkeypatch: pytest.MonkeyPatch, trying: bool
) -> None:
    def when(run: Searched) -> bool:
        return about_to_look(run, "head", trying=trying)

    spoil(monkeypatch, when, lambda model: next(model.head.parameters()))
    trainer = make(model_options=small_head)
    trainer.train()
    found = Run(trainer).found
    looks = [(look["verdict"], look["psnr"]) for look in found["curve"]]
    assert ("rejected" if trying else "resting", NO_PICTURE) in looks
    assert (found["phase"], found["head"], looks[-1][0]) == ("done", False, "reached")
    assert [psnr for _, psnr in looks].count(NO_PICTURE) == 1, "it is not waited for"
    assert all(value.isfinite().all() for value in trainer.pipeline.model.gauss_params.values())


def test_a_head_that_makes_no_picture_does_not_stay_for_its_bytes(
    make: Make, small_head: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def when(run: Searched) -> bool:
        found: Budget = run.model.budget  # type: ignore[assignment]
        return found.search.cuts > 0 and about_to_look(run, "head", trying=False)

    spoil(monkeypatch, when, lambda model: next(model.head.parameters()))
    monkeypatch.setattr(budget.sizes, "head_bytes", lambda _: 0)
    trainer = make(model_options=small_head, max_psnr_drop=3.0)
    trainer.train()
    found = Run(trainer).found
    assert found["curve"][-2]["psnr"] == NO_PICTURE
    assert (found["phase"], found["head"], found["curve"][-1]["verdict"]) == ("done", False, "reached")


def test_where_no_trial_makes_a_picture_the_warm_up_field_stays(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    restore, gone_back = Searched.restore, []

    def noted(run: Searched, saved: Any) -> None:
        trained = run.model.means.detach().clone()
        restore(run, saved)
        gone_back.append((run.model.schedule_step, torch.equal(run.model.means, trained)))

    def measure(run: Searched) -> float:
        return 20.0 if run.model.budget.search.phase == "before" else NO_PICTURE  # type: ignore[union-attr]

    monkeypatch.setattr(Searched, "restore", noted)
    monkeypatch.setattr(Searched, "measure", measure)
    trainer = make(model_options={"head": HeadConfig(mode="off")})
    trainer.train()
    found = Run(trainer).found
    assert gone_back == [(PRUNE_AT + 12, False)]
    assert (found["degrees"], found["degree"], found["steps_lost"]) == ({"1": NO_PICTURE}, 1, 12)
    assert (found["phase"], found["zeroed"], found["primitives"]) == ("done", 0, 200), "nothing to tell flat colours by"


def test_primitives_that_are_no_longer_numbers_go_at_the_next_look(
    make: Make, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def when(run: Searched) -> bool:
        return about_to_look(run, "field", trying=False)

    spoil(monkeypatch, when, lambda model: model.gauss_params["features_dc"][:3])
    # Nothing is cut at once: what is looked at next rests.
    monkeypatch.setattr(Search, "next_count", lambda self, *_: 100 if self.looks > 1 and self.accepted == 197 else None)
    trainer = make(max_psnr_drop=3.0)
    trainer.train()
    found = Run(trainer).found
    rested = [look["primitives"] for look in found["curve"] if look["verdict"] == "resting"]
    assert rested[:1] == [197], "and the look is one at the others"
    assert found["dropped_nonfinite"] == 3
    assert "dropped 3 primitives that were not finite" in capsys.readouterr().out
    assert all(look["psnr"] > 5 for look in found["curve"])
    (report,) = json.loads((trainer.base_dir / "prune.json").read_text())
    assert (report["dropped_nonfinite"], report["before"], report["after"]) == (3, 200, 100)


def test_primitives_that_are_no_longer_numbers_go_before_the_contribution(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut_to, contribution, asked = Searched.cut_to, Searched.contribution, []

    def spoiled(run: Searched, *arguments: Any) -> int:
        run.params["opacities"].data[:2] = torch.nan
        return cut_to(run, *arguments)

    def noted(run: Searched, share: float | None = None) -> Tensor:
        asked.append((run.model.num_points, share))
        return contribution(run, share)

    monkeypatch.setattr(Searched, "cut_to", spoiled)
    monkeypatch.setattr(Searched, "contribution", noted)
    trainer = make(max_psnr_drop=None, max_primitives=37)
    trainer.train()
    assert asked[0] == (198, 37 / 198)
    assert trainer.pipeline.model.num_points == 37
    assert Run(trainer).found["dropped_nonfinite"] == 2


def test_a_warm_up_without_pictures_says_so_and_is_saved(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make()
    monkeypatch.setattr(Searched, "measure", lambda _: NO_PICTURE)
    with pytest.raises(DataError, match="warm-up field .* the training has diverged, go back to an earlier checkpoint"):
        trainer.train()
    assert (trainer.checkpoint_dir / f"step-{PRUNE_AT:09d}.ckpt").exists()


def test_a_search_that_fails_does_not_lose_the_warm_up(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise DataError("the cause; the mend")

    trainer = make()
    monkeypatch.setattr(Budget, "_begin", fail)
    with pytest.raises(DataError, match="the cause"):
        trainer.train()
    assert (trainer.checkpoint_dir / f"step-{PRUNE_AT:09d}.ckpt").exists()
