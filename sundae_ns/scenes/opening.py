"""The one opener of finished scenes: runs of sundae or splatfacto and packed scenes, each as a model with its test views."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from torch import Tensor

from sundae_ns.api.opening import load
from sundae_ns.api.packing import scene_of
from sundae_ns.datamanager import SundaeDatamanager, no_images_error
from sundae_ns.errors import CheckpointError, DataError
from sundae_ns.model import SundaeModel, SundaeModelConfig
from sundae_ns.scenes import stock
from sundae_ns.scenes.packed import capture_of, hold, model_of
from sundae_ns.storage.kinds import kind_of, refuse
from sundae_ns.storage.packing import read_scene
from sundae_ns.storage.runs import checkpoint
from sundae_ns.storage.runs.config_file import load_config
from sundae_ns.storage.runs.fingerprint import fingerprint
from sundae_ns.storage.runs.folder import config_of, prunes_of


@dataclass(frozen=True)
class Opened:
    """A finished scene in evaluation mode, and the facts in its files."""

    model: SundaeModel
    cameras: list[Cameras]
    """Test cameras, each of shape ``(1,)``, on the model's device."""
    truths: list[Tensor]
    """True images ``[H, W, 3]`` in [0, 1], over the model's background, on the model's device."""
    source: Path
    """The run or file that was opened."""
    capture: Path
    """Folder of the photographs."""
    scene: str
    """Name of the capture's folder."""
    method: str
    variant: str
    kept: float | None
    """Share of the primitives that the prunes kept: the product over all prunes; None if unknown."""
    seed: int | None
    """None if unknown, as of a packed scene."""
    steps: int
    """Number of training steps."""
    prune_s: float | None
    """Seconds of its prunes; None if unknown."""
    curves: Path | None
    """Folder of tensorboard's event files; None if there cannot be any."""
    datamanager: SundaeDatamanager
    """The capture's views, training views too."""
    packed_bytes: int | None = None
    """Size of the packed file; None for a run."""
    fingerprint: str = ""
    """Of the run's options; empty for a packed scene."""


def open_scene(path: Path, *, data: Path | None = None) -> Opened:
    """Open a finished scene of any kind.

    Args:
        path: folder of a run, its ``config.yml``, or a packed scene. No code in them runs.
        data: the capture, if it has moved; a packed scene needs it.

    Raises:
        CheckpointError: nothing at this path can be opened.
        DataError: the capture is missing, or cannot be used.
        PackError: the packed scene is damaged, or has impossible values.
    """
    if kind_of(path) == "packed":
        return open_packed(path, data=data)
    refuse(
        path, ply="it comes without test views; give the folder of a finished run, its config.yml, or a packed scene"
    )
    config = config_of(path)
    if config.name == "config.yml" and config.is_file():
        return open_run(config, data=data)
    reason = "is no run" if path.exists() else "does not exist"
    raise CheckpointError(f"{path} {reason}; give the folder of a finished run, its config.yml, or a packed scene")


def open_packed(path: Path, *, data: Path | None) -> Opened:
    """Open a packed scene with the capture that it was trained on.

    Raises:
        DataError: ``data`` is None, or the capture cannot be used.
        PackError: the file is damaged, or has impossible values.
    """
    if data is None:
        raise DataError(f"{path} is a packed scene, which does not name its capture; give the capture with --data")
    packed = read_scene(path)
    device = _device()
    model = model_of(scene_of(packed)).to(device)
    manager = capture_of(packed, data).setup(device=device, test_mode="test", world_size=1, local_rank=0)
    cameras, truths = views_to_test(model, manager)
    if not cameras:
        raise DataError(f"{data} has no test views, so there is nothing to measure {path} on")
    source = packed.meta.get("source")
    source = source if isinstance(source, dict) else {}
    step = source.get("step")
    return Opened(
        model=model,
        cameras=cameras,
        truths=truths,
        source=path,
        capture=data,
        scene=_name_of(data),
        method=str(source.get("method") or "sundae"),
        variant=path.name,
        kept=None,
        seed=None,
        steps=step + 1 if isinstance(step, int) else 0,
        prune_s=None,
        curves=None,
        datamanager=manager,
        packed_bytes=path.stat().st_size,
    )


class OpenedPipeline(NamedTuple):
    """Pipeline of a run with the state of its newest whole checkpoint."""

    config: TrainerConfig
    pipeline: Any
    """nerfstudio's pipeline."""
    model: SundaeModel
    step: int
    """Training step of the checkpoint."""
    capture: Path
    fingerprint: str
    """Of the run's options."""


def open_pipeline(
    path: Path, *, data: Path | None = None, test_mode: Literal["test", "val", "inference"] = "test"
) -> OpenedPipeline:
    """Open a run of sundae or splatfacto by its ``config.yml``, on the GPU if there is one. The run is only read.

    A field of splatfacto becomes a model of ours without a head, so that one code path renders and times all methods, on a
    CPU too.

    Args:
        path: the run's ``config.yml``.
        data: the capture, if it has moved.
        test_mode: views that nerfstudio loads beside those of training.

    Raises:
        CheckpointError: the run is of another method, or has no whole checkpoint.
        DataError: its capture is missing, or cannot be used, or it was unpacked without one.
    """
    config = load_config(path)
    pipeline_config = config.pipeline if isinstance(config, TrainerConfig) else None
    model_config = getattr(pipeline_config, "model", None)
    if pipeline_config is None or not isinstance(model_config, SplatfactoModelConfig):
        raise CheckpointError(f"{path} is of a method without Gaussians; give runs of sundae or splatfacto")
    if not getattr(pipeline_config.datamanager, "images", True):
        raise no_images_error(path.parent)  # a capture given now would not be parsed as in training
    options = fingerprint(config)  # before a run of splatfacto becomes one of ours
    folder = path.parent / config.relative_model_dir
    newest, _ = checkpoint.newest_whole(folder)
    foreign = not isinstance(model_config, SundaeModelConfig)
    if foreign:
        pipeline_config.model = stock.model_config(model_config)
        pipeline_config.datamanager = stock.datamanager_config(pipeline_config.datamanager)
    capture = _capture(config, data)
    pipeline_config.datamanager.data = capture

    pipeline: Any = pipeline_config.setup(device=_device(), test_mode=test_mode)
    loaded = checkpoint.read(newest)
    if foreign:
        hold(pipeline.model, load(newest))
        pipeline.model.step = int(loaded["step"])
    else:
        pipeline.load_pipeline(loaded["pipeline"], loaded["step"])
    return OpenedPipeline(config, pipeline, cast(SundaeModel, pipeline.model), int(loaded["step"]), capture, options)


def open_run(path: Path, *, data: Path | None = None) -> Opened:
    """Open a finished run in evaluation mode, with its test views; see :func:`open_pipeline`.

    Raises:
        CheckpointError: the run is of another method, or has no whole checkpoint.
        DataError: its capture is missing, or cannot be used.
    """
    config, pipeline, model, step, capture, options = open_pipeline(path, data=data)
    pipeline.eval()
    cameras, truths = views_to_test(model, pipeline.datamanager)
    if not cameras:
        raise DataError(f"{capture} has no test views, so there is nothing to measure {path.parent} on")
    prunes, unpruned = prunes_of(path.parent), model.config.pruning.mode == "off"
    return Opened(
        model=model,
        cameras=cameras,
        truths=truths,
        source=path.parent,
        capture=capture,
        scene=_name_of(capture),
        method=config.method_name or "",
        variant=config.experiment_name or "",
        kept=1.0 if unpruned else _product(prunes),
        seed=config.machine.seed,
        steps=step + 1,
        prune_s=0.0 if unpruned else _seconds(prunes),
        curves=path.parent,
        datamanager=pipeline.datamanager,
        fingerprint=options,
    )


def load_run(path: Path, *, data: Path | None = None) -> Opened:
    """Open a finished run of sundae by its folder or ``config.yml``, and no other method's.

    Args:
        path: of the run.
        data: the capture, if it has moved.

    Raises:
        CheckpointError: there is no such run, it is of another method, or has no whole checkpoint.
        DataError: its capture is missing, or cannot be used, or it was unpacked without one.
    """
    path = config_of(path)
    refuse(
        path,
        packed="give the folder of a run, which sundae unpack makes of it beside its capture; sundae report takes it as it is",
        ply="it comes without test views; give the folder of a finished run",
    )
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist; give the folder of a finished run, or its config.yml")
    model = getattr(getattr(load_config(path), "pipeline", None), "model", None)
    if not isinstance(model, SundaeModelConfig):
        raise CheckpointError(f"{path} is a run of another method; give one of sundae")
    return open_run(path, data=data)


def _name_of(capture: Path) -> str:
    """Name of a capture's folder."""
    return (capture.parent if capture.suffix == ".json" else capture).resolve().name


def _device() -> torch.device:
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _capture(config: TrainerConfig, data: Path | None) -> Path:
    """Folder of the capture."""
    manager = cast(FullImageDatamanagerConfig, config.pipeline.datamanager)
    # The datamanager's first: it follows a capture that has moved together with the run.
    said = manager.data or config.data or manager.dataparser.data
    capture = data if data is not None else Path(said)
    if not capture.exists():
        raise DataError(f"the capture {capture} is missing; give its folder with --data")
    return capture


def views_to_test(model: SundaeModel, datamanager: SundaeDatamanager) -> tuple[list[Cameras], list[Tensor]]:
    """Test cameras and true images, as in :class:`Opened`."""
    cameras, truths = [], []
    for camera, batch in datamanager.fixed_indices_eval_dataloader:
        cameras.append(camera.to(model.device))
        image = model.get_gt_img(batch["image"])
        truths.append(model.composite_with_background(image, model._get_background_color()))
    return cameras, truths


def _product(prunes: list[dict[str, Any]]) -> float | None:
    """Share of the primitives that these prunes kept; None without a whole record."""
    try:
        return math.prod(prune["after"] / prune["before"] for prune in prunes) if prunes else None
    except (KeyError, TypeError, ZeroDivisionError):
        return None


def _seconds(prunes: list[dict[str, Any]]) -> float | None:
    """Seconds of these prunes; None without a whole record."""
    try:
        return sum(float(prune["seconds"]) for prune in prunes) if prunes else None
    except (KeyError, TypeError, ValueError):
        return None
