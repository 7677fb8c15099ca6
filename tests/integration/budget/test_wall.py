"""The search keeps what a scene needs: little of a plain wall, ten times as much of the still life."""

from __future__ import annotations

import json
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from budget_runs import tidy
from nerfstudio.scripts.train import _set_random_seed
from ray_tracing import write_still_life
from walls import add_noise, write_wall

from sundae_ns.method_configs import sundae_auto, sundae_tiny

STEPS = 1500
SMALL = (
    *("num_downscales", "warmup_length", "stop_screen_size_at", "reset_alpha_every"),
    *("densify_grad_thresh", "cull_alpha_thresh"),
)
"""Options of the model that ``sundae-tiny`` sets for small images."""


def config_for(scene: Path, out: Path) -> Any:
    """``sundae-auto`` for small images: warm-up, search and fine-tuning in the method's own proportions."""
    config, tiny = deepcopy(sundae_auto.config), sundae_tiny.config
    config.data = config.pipeline.datamanager.data = scene
    config.output_dir, config.experiment_name, config.timestamp = out, scene.name, "now"
    config.max_num_iterations, config.vis = STEPS, "tensorboard"
    config.viewer.quit_on_train_completion = True
    config.steps_per_save = config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
    model = config.pipeline.model
    for name in SMALL:
        setattr(model, name, getattr(tiny.pipeline.model, name))
    model.pruning.prune_at = model.stop_split_at = STEPS // 2
    model.pruning.stop = round(STEPS * model.pruning.stop / sundae_auto.config.max_num_iterations)
    model.pruning.search_every = STEPS // 80
    model.sh_degree_interval = STEPS // 10  # the full SH degree before the warm-up ends
    model.head.size, model.head.pixel_unshuffle, model.head.num_features = "tiny", 1, 5
    for group in config.optimizers.values():
        if group["scheduler"] is not None:
            group["scheduler"].max_steps = STEPS
    return config


def searched(write: Callable[..., Path], folder: Path) -> dict[str, Any]:
    """Train on a scene; the search's own record."""
    scene = write(folder / write.__name__, seed=0, train_views=96, test_views=6, width=64, height=64, points=1000)
    add_noise(scene, 0.03)
    config = config_for(scene, folder / "runs")
    _set_random_seed(config.machine.seed)
    try:
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.train()
    finally:
        tidy()
    found: dict[str, Any] = json.loads((trainer.base_dir / "budget.json").read_text())
    return found


@pytest.mark.long
def test_a_plain_wall_comes_out_tiny(tmp_path: Path) -> None:
    """At the same allowed drop, a painted wall keeps a tenth of the still life's primitives, and a lower SH degree."""
    still, wall = searched(write_still_life, tmp_path), searched(write_wall, tmp_path)
    assert 10 * wall["primitives"] <= still["primitives"]
    assert wall["degree"] < still["degree"]
    for found in (still, wall):
        # PSNR of the held-out views scatters: a run may end a little below its target, not by another allowed drop.
        assert found["curve"][-1]["psnr"] > found["target"] - found["budget"]["max_psnr_drop"]
