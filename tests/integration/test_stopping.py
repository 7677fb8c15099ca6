"""Whole runs on few views that end where held-out views ask for it, on a scene of a few pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer
from trial_runs import LENGTH, PRUNE_AT, STEPS, records_of, served_views, tidy, tiny_run, tiny_scene

from sundae_ns.plugin import optimizer_configs as nerfstudio_configs
from sundae_ns.train import averaging, choice, trials
from sundae_ns.train.choice import HeldOutQuality

DECIDED = PRUNE_AT + 2 * LENGTH
"""Step of the decision, after trials of no head and of a head."""
WINDOW = 2
Make = Callable[..., Trainer]
Curve = Callable[..., None]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    scene = tiny_scene(tmp_path, 16)
    yield lambda **options: tiny_run(scene, tmp_path, **options)
    tidy()


@pytest.fixture
def curve(monkeypatch: pytest.MonkeyPatch) -> Curve:
    """Fixes PSNR and SSIM of the held-out views at a step; trials end without a head."""
    monkeypatch.setattr(trials, "AVERAGED_EVERY", 1)
    monkeypatch.setattr(choice, "best_head", lambda tried, folds: "plain")

    def fix(
        decibels: Callable[[int], float], similarity: Callable[[int], float] = lambda _: 0.5, held_out: int = 2
    ) -> None:
        def measured(run: Any, **_: Any) -> list[HeldOutQuality]:
            assert len(list(run.heldout_views())) == held_out
            return [HeldOutQuality(576, decibels(run.state.step), similarity(run.state.step))]

        monkeypatch.setattr(trials, "measure_heldout", measured)

    return fix


def _watched(trainer: Trainer) -> tuple[list[int], dict[int, torch.Tensor], dict[int, float]]:
    """Collects the training views that are served, and the centres and their rate after the extensions of each step."""
    model: Any = trainer.pipeline.model
    served, last = served_views(trainer), model.train_callbacks[-1]
    centres: dict[int, torch.Tensor] = {}
    rates: dict[int, float] = {}
    act = last.after_step

    def after_step(run: Any) -> None:
        act(run)
        centres[run.state.step] = model.gauss_params["means"].detach().clone()
        rates[run.state.step] = run.state.schedulers["means"].lr_lambdas[0](run.state.step)

    last.after_step = after_step
    return served, centres, rates


def test_the_field_goes_back_trains_as_long_as_was_best_and_pauses(make: Make, curve: Curve) -> None:
    best = DECIDED + 2 * WINDOW
    curve(lambda step: 20 - 0.08 * abs(step - best) / WINDOW)
    trainer = make()
    served, centres, rates = _watched(trainer)
    trainer.train()
    # 0.08 dB below the best are 0.4% of the loss and noise, 0.16 are not.
    back, rest = best + 2 * WINDOW, best + 2 * WINDOW + 2 * WINDOW
    record = records_of(trainer)["length"]
    held = set(record["held_out_views"])
    assert record["steps_per_measurement"] == WINDOW
    assert [one["psnr"] for one in record["measured"]] == pytest.approx([19.92, 20, 19.92, 19.84])
    assert record["measured"][1]["loss"] == pytest.approx(0.8 * 0.1 + 0.2 * 0.5)
    assert record["steps_on_all_views"] == 2 * WINDOW
    assert torch.equal(centres[back], centres[DECIDED])
    assert not torch.equal(centres[back - 1], centres[DECIDED])
    # The rate has gone back too; it decays by 0.0006 in a window of this length.
    assert rates[back] == pytest.approx(rates[DECIDED], rel=1e-5)
    assert rates[back - 1] < (1 - 5e-4) * rates[DECIDED]
    assert len(held) == 2
    assert not held & set(served[DECIDED + 1 : back + 1])
    assert len(served) == rest + 1
    # The mean of the last window stays: the own weights of its last step have moved on.
    assert all(torch.equal(centres[rest], centres[step]) for step in range(rest, STEPS))
    assert not torch.equal(centres[rest], centres[rest - 1])
    assert list(trainer.checkpoint_dir.glob("*.ckpt")) == [trainer.checkpoint_dir / f"step-{STEPS - 1:09d}.ckpt"]


def test_a_pause_in_the_last_steps_is_not_averaged(make: Make, curve: Curve, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean at the end of a run has counted weights before the pause."""
    monkeypatch.setattr(averaging, "AVERAGED_EVERY", 1)
    curve(lambda step: 20 - 0.08 * abs(step - DECIDED - 10 * WINDOW) / WINDOW)
    trainer = make()
    _, centres, _ = _watched(trainer)
    trainer.train()
    rest = DECIDED + 22 * WINDOW
    assert STEPS - 10 < rest < STEPS - 1
    assert not torch.equal(centres[rest], centres[rest - 1])
    assert all(torch.equal(centres[rest], centres[step]) for step in range(rest, STEPS))


def test_views_that_a_trial_has_seen_are_not_watched(tmp_path: Path, curve: Curve) -> None:
    """With few views a trial holds out one of two, and the field that goes on has seen the other."""
    trainer = tiny_run(tiny_scene(tmp_path, 8), tmp_path)
    served, *_ = _watched(trainer)
    curve(lambda _: 20.0, held_out=1)
    trainer.train()
    tidy()
    (held,) = records_of(trainer)["length"]["held_out_views"]
    length = LENGTH // 2
    other, last = records_of(trainer)["head"]["held_out_views"]
    assert held == last
    chosen = served[PRUNE_AT + length + 1 : PRUNE_AT + 2 * length + 1]  # the second trial of no head
    assert held not in chosen
    # The views of the watch are those that are not held out, the seen one among them.
    assert other in served[PRUNE_AT + 4 * length + 1 :]


def test_a_field_that_loses_nothing_trains_to_the_end_on_all_views(make: Make, curve: Curve) -> None:
    curve(lambda _: math.nan)
    trainer = make()
    served, centres, _ = _watched(trainer)
    trainer.train()
    record = records_of(trainer)["length"]
    watched = (STEPS - DECIDED) // 2
    assert len(record["measured"]) == watched // WINDOW
    assert record["steps_on_all_views"] is None
    assert not set(record["held_out_views"]) & set(served[DECIDED + 1 : DECIDED + watched + 1])
    assert set(record["held_out_views"]) & set(served[DECIDED + watched + 1 :])
    assert len(served) == STEPS
    assert not torch.equal(centres[STEPS - 1], centres[STEPS - 2])


def test_a_warm_start_is_not_watched(make: Make, curve: Curve) -> None:
    """Its field knows the views that would be held out."""
    curve(lambda step: 20 - step)
    trainer = make()
    trainer.pipeline.model.state.offset = PRUNE_AT
    served, *_ = _watched(trainer)
    trainer.train()
    assert "head" in records_of(trainer)
    assert "length" not in records_of(trainer)
    assert len(served) == STEPS


def test_a_run_resumed_while_training_is_paused_has_figures(
    make: Make, curve: Curve, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    curve(lambda step: 20 - step)
    stop = STEPS - 25
    whole = make(name="whole", save_every=stop)
    whole.train()
    losses: list[float] = []
    put_scalar = writer.put_scalar

    def noted(name: str, scalar: Any, step: int) -> None:
        losses.extend([float(scalar)] if name == "Train Loss" else [])
        put_scalar(name, scalar, step)

    monkeypatch.setattr(writer, "put_scalar", noted)
    monkeypatch.setattr(nerfstudio_configs, "LINE_EVERY", 0.0)
    resumed = make(name="resumed", load_dir=whole.checkpoint_dir, load_step=stop, max_num_iterations=STEPS - stop - 1)
    served, centres, _ = _watched(resumed)
    capsys.readouterr()
    resumed.train()
    assert len(served) == 1, "one image is measured, and none is trained on"
    assert all(torch.equal(centres[stop + 1], centre) for centre in centres.values())
    assert len(losses) == 2
    assert all(0 < loss < 1 for loss in losses)
    assert "PSNR" in capsys.readouterr().out


def test_a_run_trains_again_after_the_end_of_its_schedule(make: Make, curve: Curve) -> None:
    curve(lambda step: 20 - step)
    first = make(name="first")
    first.train()
    longer = make(name="longer", load_dir=first.checkpoint_dir, max_num_iterations=5)
    served, *_ = _watched(longer)
    longer.train()
    assert len(served) == 5
