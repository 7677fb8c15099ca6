"""The head of a search: whether it is enabled, kept, and loaded again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from budget_runs import PRUNE_AT, SAVE, STEPS, Make, Run, same, shown_alike_when_packed, tidy

from sundae_ns.compensation import HeadConfig
from sundae_ns.scenes.measure import sizes
from sundae_ns.storage.accounting import bytes_of_head
from sundae_ns.training.budget import heads
from sundae_ns.training.budget.searched_field import SearchedField


def test_a_small_field_has_no_head_and_no_features(done: Run) -> None:
    # The head is half a megabyte, the field a few kilobytes.
    assert done.found["head_dropped"]
    assert done.model.head is None
    assert done.model.gauss_params["features"].shape == (done.model.num_points, 0)
    assert sizes(done.model).total == done.found["curve"][-1]["bytes"]
    columns = (done.found["degree"] + 1) ** 2 - 1
    assert done.model.gauss_params["features_rest"].shape[1] == columns


def test_steps_lost_with_a_head_are_counted_once(
    make: Make, small_head: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SearchedField, "measure", lambda searched: 20.0 if searched.count == 200 else 5.0)
    trainer = make(model_options=small_head)
    trainer.train()
    found = Run(trainer).found
    *_, last, _ = found["curve"]
    rejected = [p["since_cut"] for p in found["curve"] if (p["phase"], p["verdict"]) == ("field", "rejected")]
    assert [point["verdict"] for point in found["curve"] if point["phase"] == "head"].count("rejected") > 1
    assert found["head_dropped"]
    # One of two trials, rejected cuts without the head, and all steps since the head was enabled.
    assert found["steps_lost"] == 12 + sum(rejected) + last["step"] - found["head_at"]


def test_a_head_of_the_chosen_size_is_enabled_and_loaded_again(
    make: Make, small_head: dict[str, Any], tmp_path: Path
) -> None:
    options = {"model_options": small_head, "max_psnr_drop": None, "max_primitives": 37}
    trainer = make(**options)
    weights = list(trainer.pipeline.model.head.parameters())
    trainer.train()
    run, model = Run(trainer), trainer.pipeline.model
    assert (run.found["head"], run.found["head_size"], run.found["num_features"]) == (True, "tiny", 5)
    assert model.gauss_params["features"].shape == (37, 5)
    assert all(a is b for a, b in zip(weights, model.head.parameters())), "the optimizer holds these"
    assert sizes(model).total == run.found["curve"][-1]["bytes"]
    whole = run.checkpoint(STEPS - 1)
    tidy()
    start = STEPS - SAVE
    again = make(**options, load_dir=trainer.checkpoint_dir, load_step=start, max_num_iterations=STEPS - 1 - start)
    assert again.pipeline.model.head.config.size == "tiny"
    again.train()
    for part in ("pipeline", "optimizers", "random"):
        same(whole[part], Run(again).checkpoint(STEPS - 1)[part], part)
    shown_alike_when_packed(run, tmp_path)


def test_a_head_that_does_not_pay_is_removed(make: Make, small_head: dict[str, Any]) -> None:
    trainer = make(model_options=small_head)
    trainer.train()
    found = Run(trainer).found
    assert found["head_at"] > PRUNE_AT
    assert (found["head"], found["head_dropped"], found["head_size"]) == (False, True, "")
    assert trainer.pipeline.model.head is None
    assert found["curve"][-1]["verdict"] == "reached"


@pytest.mark.parametrize(
    ("primitives", "row", "expected"),
    [
        (10**6, 236, ("wide", 13)),
        (40_000, 236, ("compact", 13)),
        (20_000, 236, ("tiny", 13)),
        (20_000, 152, ("tiny", 5)),
        (60_000, 56, ("tiny", 1)),
        (3_000, 236, None),
    ],
)
def test_the_head_that_suits_a_field(primitives: int, row: int, expected: tuple[str, int] | None) -> None:
    found = heads.head_for(primitives, row, HeadConfig())
    assert (found and (found.size, found.num_features)) == expected
    if found is not None:
        assert bytes_of_head(found) <= heads.HEAD_SHARE * primitives * row
