"""Figures of a finished run: quality, bytes and synchronised times, taken from the run itself."""

from __future__ import annotations

import os
import subprocess
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
from sundae_ns.evaluation import (
    HEAD_OFF,
    HEAD_ON,
    ComparisonRow,
    Configuration,
    Lpips,
    Measured,
    ViewQuality,
    flip,
    median_ms,
    psnr,
    ssim,
)
from sundae_ns.gaussians import FEATURES
from sundae_ns.model import SundaeModel
from sundae_ns.opening import Opened
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


@torch.no_grad()
def measure_scene(
    opened: Opened,
    *,
    label: str,
    lpips: Lpips | None = None,
    warmup: int = 3,
    repeats: int = 5,
    progress: Callable[[], object] | None = None,
    command: str = "",
) -> Measured:
    """Evaluate and time a field on its test views, with the head and without.

    What is timed is the very call whose picture is evaluated, view by view.

    Args:
        opened: the field.
        label: its name in tables.
        lpips: LPIPS; None leaves it out.
        warmup: untimed renderings of each picture.
        repeats: timed renderings of each picture; 0 leaves times out.
        progress: called after each view.
        command: the command to note as the origin of the figures.
    """
    model, background = opened.model, opened.model._get_background_color()
    has_head = model.head is not None and model.head_active
    ways = {HEAD_ON: True, HEAD_OFF: False} if has_head else {HEAD_OFF: False}
    times: dict[str, list[float]] = {name: [] for name in (*ways, "head")}
    views: dict[str, list[ViewQuality]] = {name: [] for name in ways}

    def milliseconds(fn: Callable[[], object]) -> float:
        return median_ms(fn, device=model.device, warmup=warmup, repeats=repeats).median_ms

    for camera, truth in zip(opened.cameras, opened.truths, strict=True):
        view = model.view_of(camera)
        for name, compensate in ways.items():
            render = partial(model.render, model.gaussians, view, background, compensate=compensate)
            pictures, _ = render()
            views[name].append(quality(pictures["rgb"], truth, lpips))
            if repeats:
                times[name].append(milliseconds(render))
                if compensate:
                    assert model.head is not None
                    base, features, alpha = (pictures[k] for k in ("base_rgb", "feature_image", "accumulation"))
                    times["head"].append(milliseconds(partial(model.head, base, base, features, alpha)))
        if progress is not None:
            progress()
    stored = sizes(model)
    bare = {name: value for name, value in model.gauss_params.items() if name != FEATURES}
    needed = {HEAD_ON: stored.total, HEAD_OFF: bytes_of(bare)}
    return Measured(
        label=label,
        source=str(opened.source),
        scene=opened.scene,
        method=opened.method,
        variant=opened.variant,
        keep_ratio=opened.keep_ratio,
        seed=opened.seed,
        steps=opened.steps,
        primitives=model.num_points,
        bytes_primitives=stored.primitives,
        bytes_head=stored.head,
        resolution=_resolution(opened.cameras),
        configurations=tuple(
            Configuration(name, median(times[name]) if repeats else None, needed[name], tuple(views[name]))
            for name in ways
        ),
        ms_head=median(times["head"]) if times["head"] else (0.0 if repeats else None),
        lpips_net=lpips.net if lpips is not None else "",
        prune_s=opened.prune_s,
        gpu=torch.cuda.get_device_name(model.device) if model.device.type == "cuda" else "",
        commit=revision(),
        command=command,
    )


def quality(picture: Tensor, truth: Tensor, lpips: Lpips | None = None) -> ViewQuality:
    """Every metric of one picture ``[H, W, 3]`` against its truth."""
    errors = (flip(picture, truth), None if lpips is None else lpips(picture, truth))
    return ViewQuality(
        float(psnr(picture, truth)), float(ssim(picture, truth)), *(None if e is None else float(e) for e in errors)
    )


@torch.no_grad()
def pictures_of(opened: Opened, index: int) -> ComparisonRow:
    """Truth, base colours and whole picture of one test view."""
    model = opened.model
    pictures, _ = model.render(
        model.gaussians, model.view_of(opened.cameras[index]), model._get_background_color(), depth=False
    )
    return ComparisonRow(opened.truths[index], pictures["base_rgb"], pictures["rgb"])


def revision() -> str:
    """Commit of the checkout that runs, or what ``BENCHMARK_COMMIT`` says where the tree travelled without git; or empty."""
    told = os.environ.get("BENCHMARK_COMMIT")
    if told:
        return told
    folder = Path(__file__).parent
    # An installed package may lie inside somebody else's repository, whose commit says nothing.
    if not (folder.parent / ".git").exists():
        return ""
    command = ["git", "-C", str(folder), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def _resolution(cameras: Sequence[Cameras]) -> str:
    """Width x height of the first camera; captures of several sizes say so."""
    found = {(int(camera.width), int(camera.height)) for camera in cameras}
    width, height = int(cameras[0].width), int(cameras[0].height)
    return f"{width}x{height}" + (" and others" if len(found) > 1 else "")
