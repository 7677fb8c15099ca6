"""Runs of the default method on a scene of a few pixels, with trials of five steps."""

from __future__ import annotations

import json
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import profiler, writer
from torch import Tensor

from harness.still_life import write_still_life
from sundae_ns.method_configs import sundae

STEPS, PRUNE_AT = 100, 40
LENGTH = 5
"""Steps of a trial: a twentieth of so short a run. Views are held out from step 30 on."""


def tiny_scene(folder: Path, cameras: int) -> Path:
    return write_still_life(
        folder / str(cameras), train_views=cameras, test_views=2, width=24, height=24, points=200, samples=1
    )


def tiny_run(
    scene: Path,
    out: Path,
    *,
    name: str = "run",
    save_every: int = 1000,
    start_at: int | None = None,
    change: Callable[[Any], object] = lambda config: None,
    **options: Any,
) -> Trainer:
    config = deepcopy(sundae.config)
    config.data = config.pipeline.datamanager.data = scene
    config.output_dir, config.experiment_name, config.timestamp = out, name, "now"
    config.max_num_iterations, config.steps_per_save, config.save_only_latest_checkpoint = STEPS, save_every, False
    config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
    config.vis, config.viewer.quit_on_train_completion = "tensorboard", True
    model = config.pipeline.model
    model.num_downscales, model.sh_degree, model.sh_degree_interval, model.warmup_length = 0, 1, 5, 10**9
    model.pruning.prune_at, model.evaluate_prune = PRUNE_AT, False
    model.head.size, model.head.pixel_unshuffle, model.head.num_features = "tiny", 1, 5
    model.head.start_at = start_at
    for option, value in options.items():
        setattr(config, option, value)
    change(config)
    torch.manual_seed(7)
    config.save_config()
    made: Trainer = config.setup(local_rank=0, world_size=1)
    made.setup()

    def evaluate(**_: Any) -> dict[str, float]:
        assert made.training_state == "completed", "a decision must not use test views"
        return {"psnr": 20.0, "ssim": 0.5}

    made.pipeline.get_average_eval_image_metrics = evaluate
    return made


def trials_of(model: Any) -> Any:
    """The callback that decides."""
    return next(callback for callback in model.train_callbacks if callback.name == "trials")


def records_of(trainer: Trainer) -> Any:
    path = trainer.base_dir / "trials.json"
    return json.loads(path.read_text()) if path.exists() else {}


def served_views(trainer: Trainer) -> list[int]:
    """Collects the training views that are served, by step."""
    manager, views = trainer.pipeline.datamanager, []
    serve = manager.view_of_step

    def view_of_step(step: int) -> int:
        views.append(serve(step))
        return views[-1]

    manager.view_of_step = view_of_step
    return views


def tidy() -> None:
    # nerfstudio keeps its loggers in globals.
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    profiler.PROFILER.clear()


def same(a: Any, b: Any, where: str = "") -> None:
    """Assert that two states have the same tensors and numbers, except for times."""
    if isinstance(a, dict):
        assert set(a) == set(b), where
        for key in a:
            if key != "seconds":
                same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b)):
            same(x, y, f"{where}/{i}")
    elif isinstance(a, Tensor):
        assert torch.equal(a, b), where
    else:
        assert a == b or (a != a and b != b), where
