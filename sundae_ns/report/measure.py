"""Measurements of a finished scene: quality, bytes and synchronised times."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from statistics import median
from typing import Any, NamedTuple

import torch

from sundae_ns.core.gaussians import FEATURES
from sundae_ns.core.metrics import Lpips, ViewQuality, quality_of
from sundae_ns.core.timing import median_ms
from sundae_ns.io.accounting import bytes_of, bytes_of_module
from sundae_ns.plugin.finished_runs import Opened
from sundae_ns.plugin.model import SundaeModel
from sundae_ns.report.measured import HEAD_OFF, HEAD_ON, Configuration, Measured
from sundae_ns.scene.render import compensate, draw, scale_plan


class FrameTimes(NamedTuple):
    """Synchronised milliseconds of a frame, median over repeated renders."""

    frame: float  # As nerfstudio's commands request it: camera, colours, splatting of colours and features, head
    splat: float  # The same without head and features
    head: float  # Alone; 0 if it does not run. Its second splatting pass at another scale counts in ``frame`` only


@contextmanager
def compensation(model: SundaeModel, on: bool) -> Iterator[None]:
    """Enable or disable the head's correction inside a block."""
    before, model.compensated = model.compensated, on
    try:
        yield
    finally:
        model.compensated = before


@torch.no_grad()
def frame_times(model: SundaeModel, camera: Any, *, warmup: int = 3, repeats: int = 5) -> FrameTimes:
    """Time ``repeats`` renders of a camera of shape ``(1,)`` by a model in evaluation mode, after ``warmup`` others."""
    milliseconds = partial(median_ms, device=model.device, warmup=warmup, repeats=repeats)
    with compensation(model, True):
        frame = milliseconds(lambda: model.get_outputs_for_camera(camera)["rgb"])
    with compensation(model, False):
        splat = milliseconds(lambda: model.get_outputs_for_camera(camera)["rgb"])
    settings, background = model.render_settings(training=False), model._get_background_color()
    zoom, weight = scale_plan(model.camera_of(camera), settings.trained_focal)
    if settings.head is None or weight == 0:
        return FrameTimes(frame, splat, 0.0)
    scaled = model.camera_of(camera).zoomed(zoom)
    primitives = model.source.primitives(scaled, settings, features=True)
    images, splatted = draw(primitives, scaled, background, settings, depth=False)
    run_head = partial(compensate, settings.head, images["base_rgb"], splatted, background)
    return FrameTimes(frame, splat, milliseconds(run_head))


def sizes(model: SundaeModel) -> tuple[int, int]:
    """Bytes of what a render needs: of Gaussians in fp32 with features, and of the head."""
    return bytes_of(dict(model.gauss_params)), 0 if model.head is None else bytes_of_module(model.head)


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

    Args:
        opened: the scene.
        label: its name in tables.
        lpips: LPIPS; None leaves it out.
        visible: whether to compute FLIP, if its package is installed.
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
            frame, splat, head = frame_times(model, camera, warmup=warmup, repeats=repeats)
            for name, on in ways.items():
                times[name].append(frame if on else splat)
            times["head"].append(head)
        if progress is not None:
            progress()
    bare = {name: value for name, value in model.gauss_params.items() if name != FEATURES}
    # A disabled head is not needed, and neither are its features.
    stored = sizes(model) if has_head else (bytes_of(bare), 0)
    needed = {HEAD_ON: sum(stored), HEAD_OFF: bytes_of(bare)}
    if opened.packed_bytes is not None:
        # A packed file is read completely, with the head enabled or disabled.
        stored, needed = (opened.packed_bytes, 0), dict.fromkeys(needed, opened.packed_bytes)
    resolutions = [f"{int(camera.width)}x{int(camera.height)}" for camera in opened.cameras]
    precision = "" if model.head is None or not has_head else model.head.config.precision
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
        bytes_primitives=stored[0],
        bytes_head=stored[1],
        resolution=resolutions[0] + (" and others" if len(set(resolutions)) > 1 else ""),
        configurations=tuple(
            Configuration(name, median(times[name]) if repeats else None, needed[name], tuple(views[name]))
            for name in ways
        ),
        ms_head=median(times["head"]) if repeats else None,
        precision="fp32" if precision and model.device.type == "cpu" else precision,
        lpips_net=lpips.net if lpips is not None else "",
        prune_s=opened.prune_s,
        peak_primitives=model.state.pruning["peak"] or None,
        gpu=torch.cuda.get_device_name(model.device) if model.device.type == "cuda" else "",
        command=command,
    )
