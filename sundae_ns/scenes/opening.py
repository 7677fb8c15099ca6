"""Finished scenes as models with their test views: runs of sundae or splatfacto, and packed scenes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.trainer import TrainerConfig
from torch import Tensor

from sundae_ns.api.files import scene_of_checkpoint
from sundae_ns.api.packing import scene_of
from sundae_ns.datamanager import SundaeDatamanager
from sundae_ns.errors import CheckpointError, DataError
from sundae_ns.model import SundaeModel, SundaeModelConfig
from sundae_ns.scenes import stock
from sundae_ns.scenes.packed import datamanager_of, model_of, put_scene
from sundae_ns.storage.kinds import kind_of, refuse, unread
from sundae_ns.storage.pack import read_scene
from sundae_ns.storage.runs import checkpoint
from sundae_ns.storage.runs.fingerprint import fingerprint
from sundae_ns.storage.runs.folder import config_of, prunes_of


@dataclass(frozen=True)
class Opened:
    """A finished scene in evaluation mode, and the facts in its files; None for what a packed scene does not state."""

    model: SundaeModel
    cameras: list[Cameras]
    """Test cameras, each of shape ``(1,)``, on the model's device."""
    truths: list[Tensor]
    """True images ``[H, W, 3]`` in [0, 1], over the model's background, on the model's device."""
    datamanager: SundaeDatamanager
    """The capture's views, training views too."""
    source: Path
    """The run's folder, or the packed scene."""
    capture: Path
    """The photographs: a folder, or its ``transforms.json``."""
    method: str
    variant: str
    steps: int
    """Number of training steps."""
    kept: float | None = None
    """Share of the primitives that the prunes kept: the product over all prunes."""
    seed: int | None = None
    prune_s: float | None = None
    """Seconds of its prunes."""
    packed_bytes: int | None = None
    """Size of the packed file; None for a run."""
    fingerprint: str = ""
    """Of the run's options; empty for a packed scene."""

    @property
    def scene(self) -> str:
        """Name of the capture's folder."""
        return (self.capture.parent if self.capture.suffix == ".json" else self.capture).resolve().name


def open_scene(path: Path, *, data: Path | None = None) -> Opened:
    """Open a finished scene with its test views, on the GPU if there is one.

    Args:
        path: folder of a run of sundae or splatfacto, its ``config.yml``, or a packed scene. No code in them runs.
        data: the capture, if it has moved; a packed scene needs it.

    Raises:
        CheckpointError: there is no such run, it is of another method, or has no whole checkpoint.
        DataError: the capture is missing, or cannot be used, or has no test views.
        PackError: the packed scene is damaged, or has impossible values.
    """
    if kind_of(path) == "packed":
        return _open_packed(path, data)
    wanted = "give the folder of a finished run, its config.yml, or a packed scene"
    refuse(path, primitives=f"it comes without test views; {wanted}")
    config = config_of(path)
    if config.name == "config.yml" and config.is_file():
        return _open_run(config, data)
    reason = "is no run" if path.exists() else "does not exist"
    raise CheckpointError(f"{path} {unread(path) or f'{reason}; {wanted}'}")


def _open_packed(path: Path, data: Path | None) -> Opened:
    if data is None:
        raise DataError(f"{path} is a packed scene, which does not name its capture; give the capture with --data")
    packed = read_scene(path)
    device = _device()
    model = model_of(scene_of(packed)).to(device)
    manager = datamanager_of(packed, data).setup(device=device, test_mode="test", world_size=1, local_rank=0)
    source = packed.meta.get("source")
    source = source if isinstance(source, dict) else {}
    step = source.get("step")
    return _with_views(
        model,
        manager,
        source=path,
        capture=data,
        method=str(source.get("method") or "sundae"),
        variant=path.name,
        steps=step + 1 if isinstance(step, int) else 0,
        packed_bytes=path.stat().st_size,
    )


def _open_run(path: Path, data: Path | None) -> Opened:
    config, pipeline, model, step, capture, options = open_pipeline(path, data=data)
    pipeline.eval()
    prunes, unpruned = prunes_of(path.parent), model.config.pruning.mode == "off"
    return _with_views(
        model,
        pipeline.datamanager,
        source=path.parent,
        capture=capture,
        method=config.method_name or "",
        variant=config.experiment_name or "",
        steps=step + 1,
        kept=1.0 if unpruned else _product(prunes),
        seed=config.machine.seed,
        prune_s=0.0 if unpruned else _seconds(prunes),
        fingerprint=options,
    )


def _with_views(model: SundaeModel, manager: SundaeDatamanager, *, source: Path, capture: Path, **facts: Any) -> Opened:
    cameras, truths = views_to_test(model, manager)
    if not cameras:
        raise DataError(f"{capture} has no test views, so there is nothing to measure {source} on")
    return Opened(model, cameras, truths, manager, source, capture, **facts)


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

    A field of splatfacto becomes a model of ours without a head: one code path renders and times all methods.

    Args:
        path: the run's ``config.yml``.
        data: the capture, if it has moved.
        test_mode: views that nerfstudio loads beside those of training.

    Raises:
        CheckpointError: the run is of another method, or has no whole checkpoint.
        DataError: its capture is missing, or cannot be used.
    """
    config, model_config = stock.config_with_field(path)
    pipeline_config = config.pipeline
    options = fingerprint(config)  # before a run of splatfacto becomes one of ours
    folder = path.parent / config.relative_model_dir
    newest, loaded = checkpoint.read_newest(folder)
    foreign = not isinstance(model_config, SundaeModelConfig)
    if foreign:
        pipeline_config.model = stock.model_config(model_config)
        pipeline_config.datamanager = stock.datamanager_config(pipeline_config.datamanager)
    capture = _capture(config, data)
    pipeline_config.datamanager.data = capture

    pipeline: Any = pipeline_config.setup(device=_device(), test_mode=test_mode)
    if foreign:
        put_scene(pipeline.model, scene_of_checkpoint(newest, loaded, path))
        pipeline.model.step = int(loaded["step"])
    else:
        pipeline.load_pipeline(loaded["pipeline"], loaded["step"])
    return OpenedPipeline(config, pipeline, cast(SundaeModel, pipeline.model), int(loaded["step"]), capture, options)


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
        truths.append(model.truth(batch, {"background": model._get_background_color()}))
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
