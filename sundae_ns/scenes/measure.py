"""Measurements of a finished scene: quality, bytes and synchronised times, and its images beside the photographs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sundae_ns.compensation import resize
from sundae_ns.errors import BackendError, ConfigError
from sundae_ns.evaluation import (
    HEAD_OFF,
    HEAD_ON,
    ComparisonRow,
    Configuration,
    Lpips,
    Measured,
    ViewQuality,
    median_ms,
    quality_of,
    without_nan,
)
from sundae_ns.gaussians import FEATURES
from sundae_ns.model import SundaeModel
from sundae_ns.rendering import compensate, draw, scale_plan, zoomed
from sundae_ns.scenes.models import Opened, load_model
from sundae_ns.storage.accounting import Sizes, bytes_of, bytes_of_module

MOST_ZOOM = 1000
"""Factor on the sides of an image beyond which no memory holds it."""


@dataclass(frozen=True)
class FrameTimes:
    """Synchronised milliseconds of a frame, median over the cameras."""

    frame: float
    """The whole image as nerfstudio's commands request it: camera, colours, splatting of colours and features, head."""
    splat: float
    """The same without head and features."""
    head: float
    """The head alone; 0 if it does not run. Its second splatting pass at another scale counts in ``frame`` only."""


@contextmanager
def compensation(model: SundaeModel, on: bool) -> Iterator[None]:
    """Enable or disable the head's correction inside a block, except in a viewer, which has its own check box."""
    before, model.compensated = model.compensated, on
    try:
        yield
    finally:
        model.compensated = before


@torch.no_grad()
def frame_times(model: SundaeModel, cameras: Sequence[Cameras], *, warmup: int = 3, repeats: int = 5) -> FrameTimes:
    """Time the rendering of cameras at their own resolution.

    Args:
        model: in evaluation mode, on the device to time.
        cameras: each of shape ``(1,)``.
        warmup: untimed renders of each camera.
        repeats: timed renders of each camera.
    """
    background = model._get_background_color()

    def milliseconds(fn: Callable[[], object]) -> float:
        return median_ms(fn, device=model.device, warmup=warmup, repeats=repeats)

    def show(camera: Cameras) -> Tensor:
        return model.get_outputs_for_camera(camera)["rgb"]

    frames: list[float] = []
    splats: list[float] = []
    heads: list[float] = []
    for camera in cameras:
        for on, times in ((True, frames), (False, splats)):
            with compensation(model, on):
                times.append(milliseconds(partial(show, camera)))
        settings = model.render_settings(training=False)
        zoom, weight = scale_plan(model.view_of(camera), settings.trained_focal)
        if settings.head is None or weight == 0:
            heads.append(0.0)
            continue
        view = model.view_of(camera).zoomed(zoom)
        images, splatted = draw(
            model.source.primitives(view, settings, features=True), view, background, settings, depth=False
        )
        run_head = partial(compensate, settings.head, images["base_rgb"], splatted, background)
        heads.append(milliseconds(run_head))
    return FrameTimes(median(frames), median(splats), median(heads))


def sizes(model: SundaeModel) -> Sizes:
    """Bytes of everything that a render needs: primitives in fp32 with features, and the head."""
    return Sizes(bytes_of(dict(model.gauss_params)), 0 if model.head is None else bytes_of_module(model.head))


@contextmanager
def rendered_as(run: Opened, *, factor: float = 1.0, precision: str | None = None) -> Iterator[Opened]:
    """The run with images of another size, and inside the block with another arithmetic of its head.

    Args:
        run: a finished scene.
        factor: on the sides of the images; the true images are resized alike.
        precision: of the head, one of ``PRECISIONS``; by default the run's own, and fp32 on a CPU.

    Raises:
        ConfigError: the factor is not above zero or too large.
        BackendError: half precision is asked for on a CPU.
    """
    if not 0 < factor < MOST_ZOOM:
        raise ConfigError(f"images cannot be {factor} times as large; give a factor above 0 and below {MOST_ZOOM}")
    model, head = run.model, run.model.head
    if model.device.type == "cpu" and precision not in (None, "fp32"):
        raise BackendError(f"a CPU runs the head in fp32, not in {precision}; ask for fp32, or for a CUDA device")
    cameras, truths = [zoomed(camera, factor) for camera in run.cameras], []
    for camera, truth in zip(cameras, run.truths, strict=True):
        size = int(camera.height), int(camera.width)
        truths.append(truth if truth.shape[:2] == size else resize(truth, *size))
    shown = replace(run, cameras=cameras, truths=truths)
    if head is None:
        yield shown
        return
    before: Any = head.config
    changed = replace(before, precision=precision or _precision(model))
    changed.validate()
    head.config = changed
    try:
        yield shown
    finally:
        head.config = before


@torch.no_grad()
def measure_scene(
    opened: Opened,
    *,
    label: str,
    lpips: Lpips | None = None,
    visible: bool = True,
    warmup: int = 3,
    repeats: int = 5,
    progress: Callable[[], object] | None = None,
    command: str = "",
) -> Measured:
    """Evaluate and time a scene on its test views, with the head and without.

    The timed call is the one whose image is evaluated, view by view.

    Args:
        opened: the scene.
        label: its name in tables.
        lpips: LPIPS; None leaves it out.
        visible: whether to compute FLIP and JOD, which take seconds for an image, if their packages are installed.
        warmup: untimed renders of each view.
        repeats: timed renders of each view; 0 leaves times out.
        progress: called after each view.
        command: command to record as the origin of the figures.
    """
    model = opened.model
    has_head = model.state.head_enabled
    ways = {HEAD_ON: True, HEAD_OFF: False} if has_head else {HEAD_OFF: False}
    times: dict[str, list[float]] = {name: [] for name in (*ways, "head")}
    views: dict[str, list[ViewQuality]] = {name: [] for name in ways}
    for camera, truth in zip(opened.cameras, opened.truths, strict=True):
        for name, on in ways.items():
            with compensation(model, on):
                image = model.get_outputs_for_camera(camera)["rgb"]
            views[name].append(quality_of(image, truth, lpips, visible=visible))
        if repeats:
            found = frame_times(model, [camera], warmup=warmup, repeats=repeats)
            for name, on in ways.items():
                times[name].append(found.frame if on else found.splat)
            times["head"].append(found.head)
        if progress is not None:
            progress()
    bare = {name: value for name, value in model.gauss_params.items() if name != FEATURES}
    # A head that is there but disabled is not needed, and neither are its features.
    stored = sizes(model) if has_head else Sizes(bytes_of(bare), 0)
    needed = {HEAD_ON: stored.total, HEAD_OFF: bytes_of(bare)}
    if opened.packed_bytes is not None:
        # A packed file is read as a whole, with the head enabled or disabled.
        stored, needed = Sizes(opened.packed_bytes), dict.fromkeys(needed, opened.packed_bytes)
    return Measured(
        label=label,
        source=str(opened.source),
        scene=opened.scene,
        method=opened.method,
        variant=opened.variant,
        keep_ratio=opened.kept,
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
        ms_head=median(times["head"]) if repeats else None,
        precision=_precision(model) if has_head else "",
        lpips_net=lpips.net if lpips is not None else "",
        prune_s=opened.prune_s,
        peak_primitives=model.state.pruning["peak"] or None,
        gpu=torch.cuda.get_device_name(model.device) if model.device.type == "cuda" else "",
        fingerprint=opened.fingerprint,
        command=command,
    )


def evaluation(run: Path, *, data: Path | None = None) -> dict[str, Any]:
    """Metrics of a run on its test views, as ns-eval writes them; None stands for a figure that is not finite.

    Args:
        run: folder of a run of sundae or splatfacto, or its ``config.yml``. No code in it runs.
        data: the capture, if it has moved.

    Raises:
        CheckpointError: the run is of another method, or has no whole checkpoint.
        DataError: its capture is missing, or cannot be used, or has no test views.
    """
    opened = load_model(run, data)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "std_mean", UserWarning)  # of a single view, which has no deviation
        results = opened.pipeline.get_average_eval_image_metrics(get_std=True)
    plain: dict[str, Any] = without_nan(
        {
            "experiment_name": opened.variant,
            "method_name": opened.method,
            "checkpoint": str(opened.source / "nerfstudio_models" / f"step-{opened.steps - 1:09d}.ckpt"),
            "results": results,
        }
    )
    return plain


def comparison_of(model: SundaeModel, camera: Cameras, truth: Tensor, title: str) -> ComparisonRow:
    """True image, base colours and complete rendering of one view."""
    outputs = model.get_outputs_for_camera(camera)
    return ComparisonRow(truth, outputs["base_rgb"], outputs["rgb"], title)


def largest_view(opened: Opened) -> tuple[int, int]:
    """Largest width and largest height of the training and test views, in pixels."""
    _ = opened.datamanager.cached_train  # undistortion, which comes with loading, changes the cameras
    cameras = [opened.datamanager.train_dataset.cameras, *opened.cameras]
    return max(int(each.width.max()) for each in cameras), max(int(each.height.max()) for each in cameras)


@torch.no_grad()
def walk(opened: Opened) -> Iterator[ComparisonRow]:
    """Render the views in the order of their file names; titles name the file, and whether it was held out for test.

    Raises:
        DataError: an image cannot be decoded.
    """
    model, manager = opened.model, opened.datamanager
    outputs = {"background": model._get_background_color()}

    def training_view(index: int) -> tuple[Cameras, Tensor]:
        truth = model.truth(manager.cached_train[index], outputs)
        # After its image, whose undistortion changes the camera.
        return manager.train_dataset.cameras[index : index + 1].to(model.device), truth

    order = sorted(
        (path, held_out, index)
        for held_out, dataset in enumerate((manager.train_dataset, manager.eval_dataset))
        for index, path in enumerate(dataset.image_filenames)
    )
    for path, held_out, index in order:
        camera, truth = (opened.cameras[index], opened.truths[index]) if held_out else training_view(index)
        yield comparison_of(model, camera, truth, f"{path.name}, {'test' if held_out else 'training'} view")


def _precision(model: SundaeModel) -> str:
    """Arithmetic of the head on the model's device."""
    return "fp32" if model.head is None or model.device.type == "cpu" else model.head.config.precision


def _resolution(cameras: Sequence[Cameras]) -> str:
    """Width x height of the first camera, and a note if others differ."""
    found = [f"{int(camera.width)}x{int(camera.height)}" for camera in cameras]
    return found[0] + (" and others" if len(set(found)) > 1 else "")
