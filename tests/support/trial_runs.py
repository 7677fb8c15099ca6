"""Runs of the default method on a scene of a few pixels, with trials of five steps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from copy import deepcopy
from functools import reduce
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import profiler, writer
from torch import Tensor

from harness.still_life import write_still_life
from sundae_ns.method_configs import sundae

STEPS, PRUNE_AT = 100, 40
LENGTH = 5  # Steps of a trial: a twentieth of so short a run. Views are held out from step 30 on.


def tiny_scene(folder: Path, cameras: int) -> Path:
    size = {"width": 24, "height": 24, "points": 200}
    return write_still_life(folder / str(cameras), train_views=cameras, test_views=2, **size)


def set_options(config: Any, options: Mapping[str, Any]) -> None:
    """Set options of a config by their dotted names."""
    for name, value in options.items():
        *owners, last = name.split(".")
        setattr(reduce(getattr, owners, config), last, value)


def tiny_run(
    scene: Path, out: Path, *, name: str = "run", model: Mapping[str, Any] = MappingProxyType({}), **options: Any
) -> Trainer:
    """A trainer of the default method; options, and those of the model, by their dotted names."""
    config = deepcopy(sundae.config)
    config.data = config.pipeline.datamanager.data = scene
    config.output_dir, config.experiment_name, config.timestamp = out, name, "now"
    config.max_num_iterations, config.steps_per_save, config.save_only_latest_checkpoint = STEPS, 1000, False
    config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
    config.vis, config.viewer.quit_on_train_completion = "tensorboard", True
    short = {"num_downscales": 0, "sh_degree": 1, "sh_degree_interval": 5, "warmup_length": 10**9}
    small = {"head.size": "tiny", "head.pixel_unshuffle": 1, "head.num_features": 5}
    pruned = {"pruning.keep_ratio": 0.1, "pruning.prune_at": PRUNE_AT, "evaluate_prune": False}
    set_options(config.pipeline.model, {**short, **small, **pruned, **model})
    set_options(config, options)
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
    """Assert that two states have the same numbers, except for times, and the same tensors: on a CPU bit for bit."""
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
        tolerance = 0.02 if torch.cuda.is_available() else 0.0  # CUDA sums in any order
        torch.testing.assert_close(b, a, atol=tolerance, rtol=tolerance, equal_nan=True, msg=lambda m: f"{where}: {m}")
    else:
        assert a == b or (a != a and b != b), where
