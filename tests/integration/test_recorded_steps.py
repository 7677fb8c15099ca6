"""Whole runs by nerfstudio's trainer whose steps are those of recordings, run kernel by kernel on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer

from sundae_ns.errors import BackendError
from sundae_ns.storage.runs import checkpoint
from sundae_ns.training.recordable import StepResult
from sundae_ns.training.recorded import RecordedStep

MakeTrainer = Callable[[Callable[[TrainerConfig], Any]], Trainer]


class Failing(RecordedStep):
    """Fails at its tenth step, as a GPU does whose memory does not suffice."""

    steps = 0

    def __call__(self, *arguments: Any) -> StepResult:
        self.steps += 1
        if self.steps == 10:
            raise BackendError("no memory for a recording\nand a long story")
        return super().__call__(*arguments)


def trained(trainer_of: MakeTrainer, steps: type[RecordedStep] | None) -> Any:
    """A run of the tiny scene through growth, prune and trials of the head, saved every 40 steps."""

    def change(config: Any) -> None:
        config.steps_per_save, config.save_only_latest_checkpoint = 40, False
        config.pipeline.model.background_color = "black"  # a failed step draws a random one twice

    torch.manual_seed(0)
    trainer: Any = trainer_of(change)
    if steps is not None:
        trainer._recorded = steps(trainer.model.losses, record=False)
    trainer.train()
    return trainer


WORST = {"means": 0.0002, "scales": 0.0056, "opacities": 0.066, "features_dc": 0.0073}
"""Largest differences of quartiles over six seeds: rounding decides about a few primitives at thresholds of densification."""


def alike(one: Any, other: Any) -> None:
    assert one.num_points == pytest.approx(other.num_points, rel=0.02)
    for name, worst in WORST.items():
        shares = torch.tensor([0.25, 0.5, 0.75])
        found, expected = (model.gauss_params[name].detach().quantile(shares) for model in (one, other))
        torch.testing.assert_close(found, expected, rtol=0, atol=3 * worst)


def test_a_run_by_recorded_steps_is_the_same(trainer_of: MakeTrainer) -> None:
    usual, recorded = trained(trainer_of, None), trained(trainer_of, RecordedStep)
    assert recorded._recorded is not None
    alike(recorded.model, usual.model)
    for path in sorted(recorded.checkpoint_dir.glob("*.ckpt")):
        loaded = checkpoint.load(path)
        means = loaded["pipeline"]["_model.gauss_params.means"]
        assert means.untyped_storage().nbytes() == means.numel() * 4  # and not the memory beyond the field
        assert loaded["optimizers"].keys() == usual.optimizers.optimizers.keys()
    rates = [event for event in writer.EVENT_STORAGE if str(event["name"]).startswith("learning_rate")]
    assert not rates  # all are written


def test_training_goes_on_where_a_recording_fails(trainer_of: MakeTrainer, capsys: pytest.CaptureFixture[str]) -> None:
    usual, recorded = trained(trainer_of, None), trained(trainer_of, Failing)
    assert recorded._recorded is None
    assert "without recordings, slower: no memory for a recording" in " ".join(capsys.readouterr().out.split())
    alike(recorded.model, usual.model)


def test_what_cannot_be_recorded_runs_as_before(trainer_of: MakeTrainer) -> None:
    """On a CPU there is nothing to record; on a GPU, options decide."""

    def change(config: Any) -> None:
        config.max_num_iterations = 1

    trainer: Any = trainer_of(change)
    assert trainer._recorded is None
    assert not trainer._recordable()
