"""A run that is resumed at any step is the run, through all stages of trials."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from trial_runs import STEPS, records_of, same, tidy, tiny_run, tiny_scene, trials_of

from sundae_ns.train import choice, trials
from sundae_ns.train.choice import HeldOutQuality
from sundae_ns.train.pruning import PruningConfig


@pytest.fixture(autouse=True)
def figures(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Figures by stage: a fifth of the Gaussians is enough, heads pay, and later training harms."""
    monkeypatch.setattr(choice, "GAIN_PER_DOUBLING", 0.0)
    monkeypatch.setattr(trials, "AVERAGED_EVERY", 1)
    losses = (0.0, 0.0, 0.05, 0.45, 0.65, 0.8)

    def measured(run: Any, **_: Any) -> list[HeldOutQuality]:
        progress = trials_of(run.model).progress
        number = len(progress.of(progress.stage))
        gain = {
            "count": -losses[number % 6],
            "tenth": 0.3 * number,
            "head": 0.5 * number,
            "length": -0.1 * abs(number - 3),
        }
        figure = 25 + gain[progress.stage]
        # With a trace of the weights, so that other weights have other figures.
        figure += 1e-6 * float(run.state.gaussians["means"].detach().abs().mean())
        return [HeldOutQuality(100, figure, 0.5 + figure / 100, figure) for _ in run.heldout_views()]

    monkeypatch.setattr(trials, "measure_heldout", measured)
    yield
    tidy()


@pytest.mark.parametrize(
    ("cameras", "keep_ratio", "stops"),
    [
        # Before, in trials of counts and of a head on a tenth, after the decision, and while weights are averaged.
        (40, None, (11, 45, 57, 68, 95)),
        # Before the prune and right after it, in trials of heads, in those of the length, on all views, and paused.
        (16, 0.1, (37, 40, 43, 52, 61, 68, 85)),
    ],
)
def test_a_run_resumed_at_any_step_is_the_run(
    tmp_path: Path, cameras: int, keep_ratio: float | None, stops: tuple[int, ...]
) -> None:
    scene, stages = tiny_scene(tmp_path, cameras), set()

    def run(name: str, **options: Any) -> Any:
        def change(config: Any) -> None:
            config.pipeline.model.dense_start_views = 0
            config.pipeline.model.pruning = PruningConfig(keep_ratio=keep_ratio, prune_at=40)

        trainer: Any = tiny_run(scene, tmp_path, name=name, change=change, **options)
        stages.add(trials_of(trainer.model).progress.stage)
        trainer.train()
        path = trainer.checkpoint_dir / f"step-{STEPS - 1:09d}.ckpt"
        return trainer, torch.load(path, map_location="cpu", weights_only=True), records_of(trainer)

    trainer, expected, records = run("whole", save_every=1)
    for stop in stops:
        place = {"load_dir": trainer.checkpoint_dir, "load_step": stop, "max_num_iterations": STEPS - stop - 1}
        _, found, again = run(f"from {stop}", **place)
        for part in ("pipeline", "optimizers", "schedulers"):
            same(expected[part], found[part])
        assert again == records
    assert stages >= ({"count", "tenth"} if keep_ratio is None else {"head", "length", "repeat", "paused"})
