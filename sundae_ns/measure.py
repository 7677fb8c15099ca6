"""Figures of a finished run: quality, bytes and synchronised times, taken from the run itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import NamedTuple, cast

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.eval_utils import eval_setup
from torch import Tensor

from sundae_ns.datamanager import SundaeDatamanager
from sundae_ns.errors import CheckpointError
from sundae_ns.evaluation import median_ms
from sundae_ns.model import SundaeModel
from sundae_ns.storage import Sizes, bytes_of, bytes_of_module


@dataclass(frozen=True)
class FrameTimes:
    """Milliseconds a frame, device waited for, median over the given cameras."""

    frame: float
    """The whole picture: harmonics, splatting of colours, features and depth, and the head."""
    splat: float
    """The same without the head, and so without features."""
    head: float
    """The head alone; 0 without one."""


@torch.no_grad()
def frame_times(model: SundaeModel, cameras: Sequence[Cameras], *, warmup: int = 3, repeats: int = 5) -> FrameTimes:
    """Time the rendering of ``cameras`` at their own resolution.

    Args:
        model: in evaluation mode, on the device that is to be timed.
        cameras: each of shape ``(1,)``.
        warmup: untimed runs of each picture.
        repeats: timed runs of each picture.
    """
    background = model._get_background_color()

    def milliseconds(fn: Callable[[], object]) -> float:
        return median_ms(fn, device=model.device, warmup=warmup, repeats=repeats).median_ms

    frames, splats, heads = [], [], []
    for camera in cameras:
        render = partial(model.render, model.gaussians, model.view_of(camera), background)
        frames.append(milliseconds(render))
        splats.append(milliseconds(partial(render, compensate=False)))
        if model.head is not None and model.head_active:
            pictures, _ = render()
            # The blended colours are not among the pictures; the base has their shape, and the time is the same.
            base, features, alpha = (pictures[name] for name in ("base_rgb", "feature_image", "accumulation"))
            heads.append(milliseconds(partial(model.head, base, base, features, alpha)))
    return FrameTimes(median(frames), median(splats), median(heads) if heads else 0.0)


def sizes(model: SundaeModel) -> Sizes:
    """Bytes of everything that is needed to render: primitives in fp32, features and head included."""
    return Sizes(bytes_of(dict(model.gauss_params)), 0 if model.head is None else bytes_of_module(model.head))


class LoadedRun(NamedTuple):
    """A finished run."""

    model: SundaeModel
    """In evaluation mode."""
    cameras: list[Cameras]
    """Test cameras, each of shape ``(1,)``."""
    truths: list[Tensor]
    """What they photographed ``[H, W, 3]``, in [0, 1], over the model's background."""


def load_run(config: Path) -> LoadedRun:
    """Open a finished run.

    Raises:
        CheckpointError: there is no such run, or it is of another method.
    """
    if not config.is_file():
        raise CheckpointError(f"{config} does not exist; give the config.yml of a run's folder")
    _, pipeline, _, _ = eval_setup(config, test_mode="test")
    model = pipeline.model
    if not isinstance(model, SundaeModel):
        raise CheckpointError(f"{config} is a run of another method; give one of sundae")
    cameras, truths = [], []
    for camera, batch in cast(SundaeDatamanager, pipeline.datamanager).fixed_indices_eval_dataloader:
        cameras.append(camera.to(pipeline.device))
        image = model.get_gt_img(batch["image"])
        truths.append(model.composite_with_background(image, model._get_background_color()))
    return LoadedRun(model, cameras, truths)
