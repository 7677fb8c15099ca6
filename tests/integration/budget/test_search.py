"""A budget search: what it keeps and writes, and how it resumes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from budget_runs import (
    PRUNE_AT,
    SAVE,
    STEPS,
    STOP,
    Make,
    Run,
    same,
    search_of,
    set_up,
    shown_alike_when_packed,
    tidy,
)
from nerfstudio.utils.eval_utils import eval_setup
from torch import Tensor

from sundae_ns.compensation import HeadConfig
from sundae_ns.errors import CheckpointError, ConfigError
from sundae_ns.scenes.measure import sizes
from sundae_ns.scenes.opening import open_scene
from sundae_ns.storage import bytes_of
from sundae_ns.training.budget.search import SearchProgress
from sundae_ns.training.budget.searched_field import SearchedField
from sundae_ns.training.field_state import FieldState


def test_it_cuts_and_keeps_the_target(done: Run) -> None:
    found, last = done.found, done.found["curve"][-1]
    assert found["phase"] == "done"
    assert found["before"] == 200
    assert found["primitives"] == done.model.num_points < 200
    assert found["views"] == 3
    assert found["target"] == pytest.approx(found["reference"] - 0.5)
    assert (last["phase"], last["step"], last["verdict"]) == ("final", STEPS - 1, "reached")
    assert last["psnr"] >= found["target"]
    cuts = [point for point in found["curve"] if point["verdict"] in ("accepted", "rejected")]
    assert cuts
    for point in cuts:
        assert (point["psnr"] >= found["target"]) == (point["verdict"] == "accepted")
        assert PRUNE_AT < point["step"] - point["since_cut"] < STOP
    accepted = [point["primitives"] for point in cuts if point["verdict"] == "accepted"]
    assert accepted == sorted(set(accepted), reverse=True)
    assert found["primitives"] == accepted[-1]
    assert found["cost"]["steps_lost"] <= STOP - PRUNE_AT
    (report,) = json.loads((done.folder / "prune.json").read_text())
    assert (report["before"], report["after"], report["peak"]) == (200, found["primitives"], 200)
    assert open_scene(done.folder).kept == found["primitives"] / 200


def recovering(search: SearchProgress, at_last: float) -> Callable[[SearchedField], float]:
    """PSNR on held-out views: 20 dB for the whole field; a cut one is predicted to reach 19.5 dB, and does not."""

    def measure(searched: SearchedField) -> float:
        if searched.count == 200:
            return 20.0 if searched.field.sh_degree > 0 else 19.0
        age = searched.state.schedule_step - search.cut_at
        return at_last if searched.steps_left == 0 else {4: 18.0, 8: 19.0}.get(age, 19.45)

    return measure


@pytest.mark.parametrize(("at_last", "kept"), [(19.49, 200), (19.51, 100)])
def test_the_last_cut_may_take_until_the_last_step(
    make: Make, monkeypatch: pytest.MonkeyPatch, at_last: float, kept: int
) -> None:
    least: list[float] = []

    def flatten(searched: SearchedField, lowest: float) -> Tensor:
        least.append(lowest)
        return torch.zeros(searched.count, dtype=torch.bool)

    trainer = make(model_options={"head": HeadConfig(mode="off")})
    monkeypatch.setattr(SearchedField, "flatten", flatten)
    search = search_of(trainer.pipeline.model.extensions).search
    monkeypatch.setattr(SearchedField, "measure", recovering(search, at_last))
    trainer.train()
    run = Run(trainer)
    assert least == [pytest.approx(19.5 if kept == 100 else 20 - 0.25 * 0.5)], (
        "no training follows that could recover more"
    )
    *points, last, final = run.found["curve"]
    assert {point["verdict"] for point in points} == {"waiting"}
    assert (last["step"], last["primitives"]) == (STEPS - 1, 100)
    assert last["verdict"] == ("accepted" if kept == 100 else "rejected")
    assert (final["verdict"], final["primitives"], run.found["phase"]) == ("reached", kept, "done")
    assert len(run.checkpoint(STEPS - 1)["pipeline"]["_model.gauss_params.means"]) == kept


def test_a_run_that_ends_before_its_search_may_be_trained_on(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = make(model_options={"head": HeadConfig(mode="off")}, stop=STEPS)
    search = search_of(trainer.pipeline.model.extensions).search
    monkeypatch.setattr(SearchedField, "measure", recovering(search, 19.49))
    trainer.train()
    found = Run(trainer).found
    assert (found["phase"], found["trying"], found["curve"][-1]["verdict"]) == ("field", True, "missed")


END_OF_TRIALS = PRUNE_AT + 2 * 12
"""Step at which SH degree 1 has been compared with degree 0."""


def degree_0_suffices(searched: SearchedField) -> float:
    return 20.0


@pytest.mark.parametrize(
    ("stop", "steps", "degree", "lost"),
    [
        (PRUNE_AT + 1, STEPS, 0, 12),  # the trials go on after it
        (END_OF_TRIALS, END_OF_TRIALS + 1, 0, 12),
        (END_OF_TRIALS + 1, END_OF_TRIALS + 2, 0, 12),  # no time to judge another cut
        (END_OF_TRIALS - 4, END_OF_TRIALS - 3, 1, 8),  # the run ends during the second trial
        (PRUNE_AT + 5, PRUNE_AT + 6, 1, 0),  # during the first
        (PRUNE_AT, PRUNE_AT + 1, 1, 0),
    ],
)
def test_nothing_is_tried_that_cannot_be_judged(
    make: Make, monkeypatch: pytest.MonkeyPatch, stop: int, steps: int, degree: int, lost: int
) -> None:
    snapshot, kept = FieldState.snapshot, []

    def noted(state: FieldState, *, head: bool) -> Any:
        kept.append(state.field["means"].detach().clone())
        return snapshot(state, head=head)

    monkeypatch.setattr(FieldState, "snapshot", noted)
    monkeypatch.setattr(SearchedField, "measure", degree_0_suffices)
    trainer = make(model_options={"head": HeadConfig(mode="off")}, stop=stop, max_num_iterations=steps)
    trainer.train()
    run = Run(trainer)
    (final,) = run.found["curve"]
    assert (final["phase"], final["verdict"], final["primitives"]) == ("final", "reached", 200)
    assert (run.found["phase"], run.found["degree"], run.found["steps_lost"]) == ("done", degree, lost)
    assert trainer.pipeline.model.gauss_params["features_rest"].shape[1] == (degree + 1) ** 2 - 1
    if lost == 8:
        assert torch.equal(trainer.pipeline.model.means, kept[-1]), "the field of the first trial"


def test_a_run_that_ends_during_a_trial_keeps_the_count(make: Make) -> None:
    at = END_OF_TRIALS - 4
    trainer = make(max_psnr_drop=None, max_primitives=37, stop=at, max_num_iterations=at + 1)
    trainer.train()
    found = Run(trainer).found
    assert (found["phase"], found["primitives"], found["curve"][-1]["verdict"]) == ("done", 37, "reached")


@pytest.mark.parametrize("stop", [STOP, 200])
def test_no_head_is_enabled_and_nothing_is_cut_if_too_few_steps_are_left(
    make: Make, small_head: dict[str, Any], monkeypatch: pytest.MonkeyPatch, stop: int
) -> None:
    monkeypatch.setattr(SearchedField, "measure", degree_0_suffices)
    steps = END_OF_TRIALS + (5 if stop == STOP else 4)
    trainer = make(model_options=small_head, stop=stop, max_num_iterations=steps)
    trainer.train()
    found = Run(trainer).found
    assert (found["primitives"], found["trying"], found["head_at"]) == (200, False, 0)
    assert found["phase"] == ("done" if stop == STOP else "field"), "the phase before the head may go on"


@pytest.mark.parametrize("warm", [False, True])
def test_a_run_that_ends_during_its_search_says_how_far_to_train_on(
    done: Run, make: Make, capsys: pytest.CaptureFixture[str], warm: bool
) -> None:
    start = {"warm_start": done.trainer.checkpoint_dir / f"step-{SAVE:09d}.ckpt"} if warm else {}
    trainer = make(model_options=start, max_num_iterations=PRUNE_AT + 4)
    trainer.train()
    assert Run(trainer).found["phase"] == "degrees"
    expected = STOP - PRUNE_AT if warm else STOP
    assert f"train on to step {expected}." in " ".join(capsys.readouterr().out.split())


def test_its_record_is_json(done: Run) -> None:
    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} is no JSON")

    found = json.loads((done.folder / "budget.json").read_text(), parse_constant=refuse)
    assert found["lowered"] is None


def test_it_can_be_packed(done: Run, tmp_path: Path) -> None:
    shown_alike_when_packed(done, tmp_path)


def test_flat_colours_stay_flat(done: Run) -> None:
    rest = done.model.gauss_params["features_rest"]
    if rest.shape[1]:
        flat = (rest == 0).flatten(1).all(dim=1)
        assert int(flat.sum()) >= done.found["zeroed"]


def test_its_choice_is_loaded_again(done: Run) -> None:
    _, pipeline, _, step = eval_setup(done.folder / "config.yml", test_mode="test")
    model: Any = pipeline.model
    assert step == STEPS - 1
    assert model.head is None
    assert not model.state.head_enabled
    for name, value in done.model.gauss_params.items():
        assert torch.equal(model.gauss_params[name], value), name
    assert pipeline.get_average_eval_image_metrics()["psnr"] > 10


@pytest.mark.parametrize("phase", ["before", "degrees", "field", "done"])
def test_a_run_resumed_during_its_search_ends_like_one_that_never_stopped(done: Run, make: Make, phase: str) -> None:
    states = {step: done.checkpoint(step) for step in range(SAVE, STEPS, SAVE)}
    extras = {step: state["pipeline"]["_model._extra_state"] for step, state in states.items()}
    phases = {step: extra["extensions"]["budget"]["numbers"]["phase"] for step, extra in extras.items()}
    start = next(step for step, at in phases.items() if at == phase)
    left = STEPS - 1 - start
    trainer = make(load_dir=done.trainer.checkpoint_dir, load_step=start, max_num_iterations=left)
    trainer.train()
    again = Run(trainer)
    for part in ("pipeline", "optimizers", "random"):
        same(done.checkpoint(STEPS - 1)[part], again.checkpoint(STEPS - 1)[part], part)


def test_bytes_are_kept_exactly(make: Make) -> None:
    trainer = make(max_psnr_drop=None, max_bytes=6000)
    trainer.train()
    model: Any = trainer.pipeline.model
    stored = sizes(model).total
    one_more = stored + bytes_of({name: value[:1] for name, value in model.gauss_params.items()})
    assert stored <= 6000 < one_more
    assert Run(trainer).found["curve"][-1]["verdict"] == "reached"


def test_primitives_are_kept_exactly(make: Make) -> None:
    trainer = make(max_psnr_drop=None, max_primitives=37)
    trainer.train()
    assert trainer.pipeline.model.num_points == 37
    point, final = Run(trainer).found["curve"]
    assert (point["verdict"], point["primitives"], final["primitives"]) == ("cut", 37, 37)
    assert (point["since_cut"], final["since_cut"]) == (0, final["step"] - point["step"])


def test_a_warm_up_by_mcmc_ends_at_its_cap(make: Make) -> None:
    chain = {"warmup": "mcmc", "mcmc_cap": 260, "warmup_length": 0, "refine_every": 3}
    trainer = make(model_options=chain, max_psnr_drop=None, max_primitives=37)
    trainer.train()
    model: Any = trainer.pipeline.model
    assert (Run(trainer).found["before"], model.state.pruning["peak"], model.num_points) == (260, 260, 37)


def test_bytes_too_few_for_one_primitive(make: Make) -> None:
    with pytest.raises(ConfigError, match="max-bytes is 10, and one primitive takes 56; give more"):
        make(max_psnr_drop=None, max_bytes=10)


def test_views_have_to_be_held_out(scene: Path, tmp_path: Path) -> None:
    trainer = set_up(scene, tmp_path)
    config = trainer.config
    tidy()
    config.pipeline.datamanager.holdout_every = 0
    with pytest.raises(ConfigError, match="holdout-every"):
        config.setup(local_rank=0, world_size=1).setup()
    tidy()


def test_a_checkpoint_without_its_search_is_refused(done: Run, make: Make) -> None:
    model: Any = make().pipeline.model
    state = {name[len("_model.") :]: value for name, value in done.checkpoint(STEPS - 1)["pipeline"].items()}
    extra = state["_extra_state"]
    others = {name: value for name, value in extra["extensions"].items() if name != "budget"}
    broken = {**state, "_extra_state": {**extra, "extensions": others}}
    with pytest.raises(CheckpointError, match="without a budget search"):
        model.load_state_dict(broken)
    model.load_state_dict(state)
    assert model.num_points == done.model.num_points
