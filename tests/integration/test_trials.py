"""Whole runs that decide how they are finished, on a scene of a few pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.eval_utils import eval_setup
from trial_runs import LENGTH, PRUNE_AT, records_of, served_views, tidy, tiny_run, tiny_scene, trials_of

from sundae_ns.plugin.finished_runs import load_run
from sundae_ns.plugin.model import NerfstudioRun
from sundae_ns.report.measure import sizes
from sundae_ns.scene.packing import contents_of
from sundae_ns.train import choice, trials
from sundae_ns.train.choice import HeldOutQuality

DECIDED = PRUNE_AT + 3 * LENGTH
"""Step of the decision if all candidates are tried."""
NONE = (0.0, 0.0)
Make = Callable[..., Trainer]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Path]:
    folder = tmp_path_factory.mktemp("scenes")
    return cache(lambda views: tiny_scene(folder, views))


@pytest.fixture
def make(scenes: Callable[[int], Path], tmp_path: Path) -> Iterator[Make]:
    yield lambda views=16, **options: tiny_run(scenes(views), tmp_path, **options)
    tidy()


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Fixes what the candidates gain on every held-out view: PSNR in dB, SSIM. Bytes of a tiny field do not count."""
    monkeypatch.setattr(choice, "GAIN_PER_DOUBLING", 0.0)
    monkeypatch.setattr(trials, "AVERAGED_EVERY", 1)  # means, in trials of five steps
    monkeypatch.setattr(trials, "MEAN_SHARE", 0.6)

    def fix(head: tuple[float, float] = NONE, features: tuple[float, float] = NONE) -> None:
        real = trials.measure_heldout

        def measured(run: Any, **_: Any) -> list[HeldOutQuality]:
            state, width = run.state, run.state.gaussians["features"].shape[1]
            decibels, similarity = NONE
            if state.head_enabled:
                assert state.head.config.num_features == width
                decibels, similarity = features if width == 29 else head
            # With a trace of what was measured, so that other weights have other figures.
            return [
                HeldOutQuality(view.pixels, 20 + decibels + 1e-4 * view.psnr, 0.5 + similarity) for view in real(run)
            ]

        monkeypatch.setattr(trials, "measure_heldout", measured)

    return fix


def _record(trainer: Trainer) -> dict[str, Any]:
    return dict(records_of(trainer)["head"])


def test_a_head_that_pays_stays_and_all_views_are_trained_on_again(make: Make, judge: Any) -> None:
    judge(head=(0.5, 0.01))
    trainer = make()
    served = served_views(trainer)
    trainer.train()
    model: Any = trainer.pipeline.model
    record = _record(trainer)
    held = set(record["held_out_views"])
    assert record["decision"] == "head"
    assert record["step"] == DECIDED
    assert record["arms"]["head"]["psnr"] == pytest.approx(20.5, abs=0.01)
    assert record["arms"]["head"]["bytes"] == sum(sizes(model))
    assert model.head is not None
    assert model.state.head_enabled
    assert len(held) == 2
    assert not held & set(served[31 : DECIDED + 1])
    assert held & set(served[:30])
    assert held & set(served[DECIDED + 1 :])
    moved = model.head.net.out.weight.abs().max()
    assert moved > 0


@pytest.mark.parametrize("gains", [(0.5, -0.001), (math.nan, 0.01)])
def test_a_head_that_does_not_pay_costs_nothing(make: Make, judge: Any, gains: tuple[float, float]) -> None:
    judge(head=gains)
    trainer = make()
    trainer.train()
    model: Any = trainer.pipeline.model
    assert _record(trainer)["decision"] == "plain"
    assert model.head is None
    assert model.gauss_params["features"].numel() == 0
    saved = torch.load(next(trainer.checkpoint_dir.glob("*.ckpt")), map_location="cpu", weights_only=True)
    assert not [name for name in saved["pipeline"] if "head" in name]
    opened = eval_setup(trainer.base_dir / "config.yml", test_mode="test")[1].model
    assert opened.head is None
    camera = trainer.pipeline.datamanager.train_dataset.cameras[0:1]
    with torch.no_grad():
        images = [one.eval().get_outputs_for_camera(camera) for one in (model, opened)]
    assert torch.equal(images[0]["rgb"], images[1]["rgb"])
    assert torch.equal(images[0]["rgb"], images[0]["base_rgb"])
    scene = contents_of(load_run(trainer.base_dir))
    assert not scene.head
    assert not any(value.numel() for name, value in scene.gaussians.items() if name == "features")


@pytest.mark.parametrize(
    ("chosen", "head", "features", "tried"),
    [("plain", -1.0, 0.0, 2), ("features", 0.3, 0.5, 3)],
)
def test_the_trials_start_alike_and_the_chosen_field_continues(
    make: Make, judge: Any, chosen: str, head: float, features: float, tried: int
) -> None:
    judge(head=(head, 0.01), features=(features, 0.02))
    trainer = make()
    model: Any = trainer.pipeline.model
    trial = trials_of(model)
    seen: dict[int, tuple[torch.Tensor, float]] = {}
    head_rates: dict[int, list[float]] = {}
    real = trial.after_prune

    def after_step(run: Any) -> None:
        real(run)
        head_rates[run.state.step] = [group["lr"] for group in run.state.optimizers["compensation"].param_groups]
        rate = run.state.schedulers["means"].lr_lambdas[0](run.state.step)
        seen[run.state.step] = (model.gauss_params["means"].detach().clone(), rate)

    trial.after_prune = after_step
    trainer.train()
    starts = [PRUNE_AT + i * LENGTH for i in range(tried)]
    # All trials start from the field and the rate right after the prune.
    for step in starts[1:]:
        assert torch.equal(seen[starts[0]][0], seen[step][0])
        assert seen[starts[0]][1] == pytest.approx(seen[step][1])
    # Each head's rate rises from the first step of its trial on, and is as high as it may be well before the end.
    for step in starts[1:]:
        for lowest, highest in zip(head_rates[step], head_rates[step + LENGTH // 2], strict=True):
            assert lowest == pytest.approx(highest * 2 / (round(trials.RISE_SHARE * LENGTH) + 1), rel=0.05)
    decided, place = PRUNE_AT + tried * LENGTH, choice.HEADS.index(chosen) + 1
    end = seen[PRUNE_AT + place * LENGTH - 1][0]
    assert not torch.equal(end, seen[PRUNE_AT][0])
    # The field at the end of the chosen trial is one step away from the last that was seen of it.
    distances = [(seen[decided][0] - seen[PRUNE_AT + i * LENGTH - 1][0]).abs().max() for i in range(1, tried + 1)]
    assert min(distances) == distances[place - 1]
    record = _record(trainer)
    assert (record["decision"], record["step"], len(record["arms"])) == (chosen, decided, tried)
    # A head that was chosen has trained for one trial.
    assert trials_of(model).taken_back == (tried - 1) * LENGTH
    width = {"plain": 0, "head": 5, "features": 29}[chosen]
    assert model.gauss_params["features"].shape[1] == width
    assert (model.head is None) == (chosen == "plain")
    opened = eval_setup(trainer.base_dir / "config.yml", test_mode="test")[1].model
    camera = trainer.pipeline.datamanager.train_dataset.cameras[0:1]
    with torch.no_grad():
        images = [one.eval().get_outputs_for_camera(camera)["rgb"] for one in (model, opened)]
    assert torch.equal(*images)
    assert contents_of(load_run(trainer.base_dir)).gaussians.get("features", torch.zeros(1, 0)).shape[1] == width


def test_with_few_views_two_are_held_out_in_turn(make: Make, judge: Any) -> None:
    judge(head=(0.5, 0.01))
    trainer = make(8)
    served = served_views(trainer)
    trainer.train()
    first, second = _record(trainer)["held_out_views"]
    length = LENGTH // 2
    served_by_trial = [served[PRUNE_AT + 1 + i * length : PRUNE_AT + 1 + (i + 1) * length] for i in range(6)]
    assert _record(trainer)["decision"] == "head"
    assert _record(trainer)["steps_per_trial"] == length
    assert not any(first in trial for trial in served_by_trial[::2])
    assert not any(second in trial for trial in served_by_trial[1::2])
    assert trainer.pipeline.model.head.config.num_features == 5


def test_with_too_few_views_the_head_stays_off(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    trainer = make(5)
    trainer.train()
    assert trainer.pipeline.model.head is None
    assert _record(trainer) == {
        "decision": "plain",
        "reason": "5 training views are too few to tell whether a head helps",
        "step": 0,
    }
    assert "the head is removed: 5 training views are too few" in " ".join(capsys.readouterr().out.split())


def test_masks_that_leave_no_pixel_leave_no_head(make: Make, judge: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    judge(head=(0.5, 0.01))
    monkeypatch.setattr(trials, "measure_heldout", lambda run, **_: [])
    trainer = make()
    trainer.train()
    assert _record(trainer)["decision"] == "plain"
    assert _record(trainer)["reason"] == "masks leave no pixel of the held-out training views"
    assert trainer.pipeline.model.head is None
    assert trainer.pipeline.datamanager.holdout_indices == []


def test_several_gpus_train_the_head_without_trials(make: Make, judge: Any) -> None:
    """The head of the trial that one GPU was in."""
    judge(head=(0.5, 0.05))
    stop = PRUNE_AT + 2 * LENGTH + 2
    whole = make(name="whole", save_every=stop)
    whole.train()
    resumed = make(name="resumed", load_dir=whole.checkpoint_dir, load_step=stop, max_num_iterations=3)
    model: Any = resumed.pipeline.model
    trials_of_run = trials_of(model)
    assert "start" in trials_of_run.kept
    resumed.ranks.count = 2
    attributes = TrainingCallbackAttributes(resumed.optimizers, resumed.grad_scaler, resumed.pipeline, resumed)
    trials_of_run.before_training(NerfstudioRun(model, attributes))
    resumed.ranks.count = 1
    resumed.train()
    assert _record(resumed)["reason"] == "trials need a single GPU"
    assert model.state.head_enabled
    assert model.gauss_params["features"].shape[1] == 29
    assert resumed.pipeline.datamanager.holdout_indices == []
    assert trials_of_run.kept == {}
