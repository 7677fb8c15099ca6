"""A search with heads, primitives and images that are not finite, and a search that fails."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
import torch
from budget_runs import PRUNE_AT, Make, Run, search_of
from torch import Tensor

from sundae_ns.compensation import HeadConfig
from sundae_ns.errors import DataError
from sundae_ns.storage import accounting
from sundae_ns.training.budget import BudgetSearch
from sundae_ns.training.budget.search import NO_IMAGE, SearchProgress
from sundae_ns.training.budget.searched_field import SearchedField
from sundae_ns.training.extension import TrainingRun
from sundae_ns.training.field_state import FieldState

When = Callable[[BudgetSearch, SearchedField], bool]


def spoil(monkeypatch: pytest.MonkeyPatch, when: When, values: Callable[[FieldState], Any]) -> None:
    """Make some numbers of a field NaN after the first training step for which ``when`` is true."""
    after_step, done = BudgetSearch.after_step, []

    def spoiled(self: BudgetSearch, run: TrainingRun) -> None:
        if not done and when(self, self.searched(run)):
            values(run.state).data.fill_(torch.nan)
            done.append(run.state.step)
        after_step(self, run)

    monkeypatch.setattr(BudgetSearch, "after_step", spoiled)


def about_to_evaluate(extension: BudgetSearch, searched: SearchedField, phase: str, *, trying: bool) -> bool:
    search = extension.search
    return (search.phase, search.trying) == (phase, trying) and extension._evaluation_is_due(searched)


@pytest.mark.parametrize("trying", [False, True])
def test_a_head_that_is_not_finite_is_removed(
    make: Make, small_head: dict[str, Any], monkeypatch: pytest.MonkeyPatch, trying: bool
) -> None:
    def when(extension: BudgetSearch, searched: SearchedField) -> bool:
        return about_to_evaluate(extension, searched, "head", trying=trying)

    spoil(monkeypatch, when, weights_of_head)
    trainer = make(model_options=small_head)
    trainer.train()
    found = Run(trainer).found
    points = [(point["verdict"], point["psnr"]) for point in found["curve"]]
    assert ("rejected" if trying else "no cut", NO_IMAGE) in points
    assert (found["phase"], found["head"], points[-1][0]) == ("done", False, "reached")
    assert [psnr for _, psnr in points].count(NO_IMAGE) == 1, "the search does not wait for it"
    assert all(value.isfinite().all() for value in trainer.pipeline.model.gauss_params.values())


def weights_of_head(state: FieldState) -> Tensor:
    assert state.head is not None
    return next(state.head.parameters())


def test_a_head_that_renders_no_image_is_not_kept_for_its_bytes(
    make: Make, small_head: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def when(extension: BudgetSearch, searched: SearchedField) -> bool:
        return extension.search.cuts > 0 and about_to_evaluate(extension, searched, "head", trying=False)

    spoil(monkeypatch, when, weights_of_head)
    monkeypatch.setattr(accounting, "bytes_of_head", lambda _: 0)
    trainer = make(model_options=small_head, max_psnr_drop=3.0)
    trainer.train()
    found = Run(trainer).found
    assert found["curve"][-2]["psnr"] == NO_IMAGE
    assert (found["phase"], found["head"], found["curve"][-1]["verdict"]) == ("done", False, "reached")


def test_the_warm_up_field_stays_if_no_trial_renders_an_image(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    go_back, restored = SearchedField.go_back, []
    trainer = make(model_options={"head": HeadConfig(mode="off")})
    search = search_of(trainer.pipeline.model.extensions).search

    def noted(searched: SearchedField, name: str) -> None:
        trained = searched.field["means"].detach().clone()
        go_back(searched, name)
        restored.append((searched.state.schedule_step, torch.equal(searched.field["means"], trained)))

    monkeypatch.setattr(SearchedField, "go_back", noted)
    monkeypatch.setattr(SearchedField, "measure", lambda _: 20.0 if search.phase == "before" else NO_IMAGE)
    trainer.train()
    found = Run(trainer).found
    assert restored == [(PRUNE_AT + 12, False)]
    assert (found["degrees"], found["degree"], found["steps_lost"]) == ({"1": NO_IMAGE}, 1, 12)
    assert (found["phase"], found["zeroed"], found["primitives"]) == ("done", 0, 200), (
        "no PSNR to judge flat colours by"
    )


def test_primitives_that_are_not_finite_are_removed_at_the_next_evaluation(
    make: Make, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def when(extension: BudgetSearch, searched: SearchedField) -> bool:
        return about_to_evaluate(extension, searched, "field", trying=False)

    spoil(monkeypatch, when, lambda state: state.field["features_dc"][:3])
    # Nothing is cut at once: the verdict of the next evaluation is "no cut".
    monkeypatch.setattr(
        SearchProgress, "next_count", lambda self, *_: 100 if self.looks > 1 and self.accepted == 197 else None
    )
    trainer = make(max_psnr_drop=3.0)
    trainer.train()
    found = Run(trainer).found
    rested = [point["primitives"] for point in found["curve"] if point["verdict"] == "no cut"]
    assert rested[:1] == [197], "the other primitives are evaluated"
    assert found["dropped_nonfinite"] == 3
    assert "removed 3 primitives that were not finite" in capsys.readouterr().out
    assert all(point["psnr"] > 5 for point in found["curve"])
    (report,) = json.loads((trainer.base_dir / "prune.json").read_text())
    assert (report["dropped_nonfinite"], report["before"], report["after"]) == (3, 200, 100)


def test_primitives_that_are_not_finite_are_removed_before_the_contribution(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut_to, contribution, asked = SearchedField.cut_to, SearchedField.contribution, []

    def spoiled(searched: SearchedField, count: int) -> None:
        searched.field["opacities"].data[:2] = torch.nan
        cut_to(searched, count)

    def noted(searched: SearchedField, count: int | None = None) -> Tensor:
        asked.append((searched.count, count))
        return contribution(searched, count)

    monkeypatch.setattr(SearchedField, "cut_to", spoiled)
    monkeypatch.setattr(SearchedField, "contribution", noted)
    trainer = make(max_psnr_drop=None, max_primitives=37)
    trainer.train()
    assert asked[0] == (198, 37)
    assert trainer.pipeline.model.num_points == 37
    assert Run(trainer).found["dropped_nonfinite"] == 2


def test_a_warm_up_that_diverged_is_reported_and_saved(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make()
    monkeypatch.setattr(SearchedField, "measure", lambda _: NO_IMAGE)
    with pytest.raises(
        DataError, match="warm-up field .* the training has diverged, resume from an earlier checkpoint"
    ):
        trainer.train()
    assert (trainer.checkpoint_dir / f"step-{PRUNE_AT:09d}.ckpt").exists()


def test_a_search_that_fails_does_not_lose_the_warm_up(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise DataError("the cause; the mend")

    trainer = make()
    monkeypatch.setattr(BudgetSearch, "_begin", fail)
    with pytest.raises(DataError, match="the cause"):
        trainer.train()
    assert (trainer.checkpoint_dir / f"step-{PRUNE_AT:09d}.ckpt").exists()
