"""Figures of a finished run: quality, bytes and synchronised times, taken from the run itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.eval_utils import eval_setup

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


def load_run(config: Path) -> tuple[SundaeModel, list[Cameras]]:
    """A finished run's model, in evaluation mode, and its test cameras.

    Raises:
        CheckpointError: there is no such run, or it is of another method.
    """
    if not config.is_file():
        raise CheckpointError(f"{config} does not exist; give the config.yml of a run's folder")
    _, pipeline, _, _ = eval_setup(config, test_mode="test")
    if not isinstance(pipeline.model, SundaeModel):
        raise CheckpointError(f"{config} is a run of another method; give one of sundae")
    assert pipeline.datamanager.eval_dataset is not None
    cameras = pipeline.datamanager.eval_dataset.cameras.to(pipeline.device)
    return pipeline.model, [cameras[i : i + 1] for i in range(len(cameras))]
