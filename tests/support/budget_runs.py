"""Budget searches on a scene of a few pixels, for the tests of ``tests/integration/budget``."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import profiler, writer
from nerfstudio.utils.eval_utils import eval_setup
from torch import Tensor

from sundae_ns.callbacks import NerfstudioRun
from sundae_ns.evaluation import psnr
from sundae_ns.method_configs import sundae_auto
from sundae_ns.scenes.finetune import finetune
from sundae_ns.scenes.packed import contents_of_run, write_run
from sundae_ns.storage.packing import PackConfig, read_scene, write_fitted
from sundae_ns.training.budget import BudgetSearch
from sundae_ns.training.budget.searched_field import SearchedField
from sundae_ns.training.extension import Extension

STEPS, SAVE, PRUNE_AT, STOP = 90, 10, 20, 70
Make = Callable[..., Trainer]


def tidy() -> None:
    # nerfstudio keeps its loggers in globals.
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    profiler.PROFILER.clear()


def set_up(scene: Path, out: Path, *, model_options: dict[str, Any] | None = None, **pruning: Any) -> Trainer:
    config = deepcopy(sundae_auto.config)
    config.data = config.pipeline.datamanager.data = scene
    config.pipeline.datamanager.holdout_every = 4
    config.output_dir, config.experiment_name, config.timestamp = out, "budget", "now"
    config.max_num_iterations, config.steps_per_save, config.save_only_latest_checkpoint = STEPS, SAVE, False
    config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
    config.vis = "tensorboard"
    config.viewer.quit_on_train_completion = True
    model = config.pipeline.model
    model.num_downscales, model.sh_degree, model.sh_degree_interval, model.warmup_length = 0, 1, 5, 10**9
    model.head.mode, model.head.size, model.head.pixel_unshuffle, model.head.num_features = "residual", "tiny", 1, 5
    for name, value in (model_options or {}).items():
        setattr(model, name, value)
    options = {"prune_at": PRUNE_AT, "stop": STOP, "search_every": 4, "patience": 2, "max_psnr_drop": 0.5, **pruning}
    for name, value in options.items():
        load_into = config if hasattr(config, name) else model.pruning
        setattr(load_into, name, value)
    torch.manual_seed(7)
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    # A search must not use test views.
    trainer.pipeline.get_average_eval_image_metrics = None
    return trainer


def search_of(extensions: Sequence[Extension]) -> BudgetSearch:
    """The budget search among the extensions of a model."""
    (found,) = (extension for extension in extensions if isinstance(extension, BudgetSearch))
    return found


def searched_field(trainer: Trainer) -> SearchedField:
    """The field of a trainer under search."""
    model: Any = trainer.pipeline.model
    attributes = TrainingCallbackAttributes(trainer.optimizers, trainer.grad_scaler, trainer.pipeline, trainer)
    return search_of(model.extensions).searched(NerfstudioRun(model, attributes))


class Run:
    """A finished run."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer, self.folder = trainer, trainer.base_dir
        self.model: Any = trainer.pipeline.model
        self.found: dict[str, Any] = json.loads((self.folder / "budget.json").read_text())

    def checkpoint(self, step: int) -> dict[str, Any]:
        return torch.load(self.trainer.checkpoint_dir / f"step-{step:09d}.ckpt", map_location="cpu", weights_only=True)


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


def shown_alike_when_packed(run: Run, folder: Path) -> None:
    """Assert that a packed and fine-tuned run of a budget search shows the same images."""
    scene = contents_of_run(run.folder)
    trained, codecs = finetune(run.folder, scene, PackConfig(), 1)
    write_fitted(folder / "a.sundae", trained, codecs)
    found = eval_setup(write_run(read_scene(folder / "a.sundae"), folder, "packed"), test_mode="test")[1].model
    assert (found.head is None) == (run.model.head is None)
    camera = run.trainer.pipeline.datamanager.train_dataset.cameras[0:1]
    with torch.no_grad():
        images = [model.eval().get_outputs_for_camera(camera)["rgb"] for model in (run.model, found)]
    assert psnr(*images) > 30
