"""Finished scenes, opened for measuring: whatever a path leads to becomes one kind of model with its test views."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple, cast

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from torch import Tensor

from sundae_ns.compensation import HeadConfig
from sundae_ns.datamanager import SundaeDatamanager, SundaeDatamanagerConfig, without_pictures
from sundae_ns.errors import CheckpointError, DataError
from sundae_ns.model import SundaeModel, SundaeModelConfig
from sundae_ns.pruning import PruningConfig
from sundae_ns.scenes.packed import write_run
from sundae_ns.storage.kinds import kind_of, refuse
from sundae_ns.storage.packing import read_scene
from sundae_ns.storage.runs import checkpoint
from sundae_ns.storage.runs.config_file import load_config
from sundae_ns.storage.runs.folder import config_of


@dataclass(frozen=True)
class Opened:
    """A finished scene in evaluation mode, and what its files say of it."""

    model: SundaeModel
    cameras: list[Cameras]
    """Test cameras, each of shape ``(1,)``, on the model's device."""
    truths: list[Tensor]
    """What they photographed ``[H, W, 3]``, in [0, 1], over the model's background, on the model's device."""
    source: Path
    """What was opened."""
    capture: Path
    """Where the photographs are."""
    scene: str
    """Name of the capture's folder."""
    method: str
    variant: str
    keep_ratio: float | None
    seed: int | None
    """None where it is not known, as of a packed scene."""
    steps: int
    """Training steps that were done."""
    prune_s: float | None
    """Seconds that its prunes took; None where nothing is known of them."""
    curves: Path | None
    """Folder to look for tensorboard's event files in; None where there cannot be any."""
    packed_bytes: int | None = None
    """Size of the packed file that was opened; None of a run."""


def open_scene(path: Path, *, data: Path | None = None) -> Opened:
    """Open a finished scene. This is the one place that knows the kinds; a new kind is one more branch here.

    Args:
        path: folder of a run, its ``config.yml``, or a packed scene; nothing in them is run.
        data: where the capture is, if not where the run says. A packed scene does not say.

    Raises:
        CheckpointError: nothing there that can be opened.
        DataError: the capture is gone, or cannot be used.
        PackError: the packed scene is damaged, or states what cannot be.
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
    """Open a file that ``sundae pack`` wrote, with the capture that it was trained on.

    Raises:
        DataError: it is not said where the capture is, or it cannot be used.
        PackError: the file is damaged, or states what cannot be.
    """
    if data is None:
        raise DataError(f"{path} is a packed scene, which does not say where its capture is; say it with --data")
    scene = read_scene(path)
    with TemporaryDirectory() as folder:
        opened = open_run(write_run(scene, Path(folder), path.stem, data=data))
    source = scene.meta.get("source")
    source = source if isinstance(source, dict) else {}
    step = source.get("step")
    return replace(
        opened,
        source=path,
        method=str(source.get("method") or opened.method),
        variant=path.name,
        keep_ratio=None,
        seed=None,
        steps=step + 1 if isinstance(step, int) else 0,
        prune_s=None,
        curves=None,
        packed_bytes=path.stat().st_size,
    )


class OpenedPipeline(NamedTuple):
    """A run's pipeline with the state of its newest whole checkpoint."""

    config: TrainerConfig
    pipeline: Any
    """nerfstudio's, its type unknown to mypy beyond the base class."""
    model: SundaeModel
    step: int
    """Of the checkpoint."""
    capture: Path


def open_pipeline(
    path: Path, *, data: Path | None = None, test_mode: Literal["test", "val", "inference"] = "test"
) -> OpenedPipeline:
    """Open a run of sundae or of splatfacto by its ``config.yml``, on the GPU if there is one. The run is only read.

    A field of splatfacto is opened as a model of ours without a head, so that all methods are rendered and timed by the
    same code, on a CPU too.

    Args:
        path: the run's ``config.yml``, which is a program: open your own.
        data: where the capture is, if not where the run says.
        test_mode: which views nerfstudio is to have beside those of training.

    Raises:
        CheckpointError: the run is of another method, or has no whole checkpoint.
        DataError: its capture is gone, or cannot be used, or it was unpacked without one.
    """
    config = load_config(path)
    pipeline_config = config.pipeline if isinstance(config, TrainerConfig) else None
    model_config = getattr(pipeline_config, "model", None)
    if pipeline_config is None or not isinstance(model_config, SplatfactoModelConfig):
        raise CheckpointError(f"{path} is of a method without Gaussians; give runs of sundae or splatfacto")
    if not getattr(pipeline_config.datamanager, "pictures", True):
        raise without_pictures(path.parent)  # and a capture given now would not be read as it was in training
    folder = path.parent / config.relative_model_dir
    newest, _ = checkpoint.newest_whole(folder)
    stock = not isinstance(model_config, SundaeModelConfig)
    if stock:
        pipeline_config.model = _without_extras(model_config, newest)
        pipeline_config.datamanager = _our_datamanager(cast(FullImageDatamanagerConfig, pipeline_config.datamanager))
    capture = _capture(config, data)
    pipeline_config.datamanager.data = capture

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    pipeline: Any = pipeline_config.setup(device=device, test_mode=test_mode)
    loaded = checkpoint.load(newest)
    if stock:
        pipeline.model.step = int(loaded["step"])
    else:
        pipeline.load_pipeline(loaded["pipeline"], loaded["step"])
    return OpenedPipeline(config, pipeline, cast(SundaeModel, pipeline.model), int(loaded["step"]), capture)


def open_run(path: Path, *, data: Path | None = None) -> Opened:
    """Open a finished run in evaluation mode, with its test views; see :func:`open_pipeline`.

    Raises:
        CheckpointError: the run is of another method, or has no whole checkpoint.
        DataError: its capture is gone, or cannot be used.
    """
    config, pipeline, model, step, capture = open_pipeline(path, data=data)
    pipeline.eval()
    cameras, truths = views_to_test(model, pipeline.datamanager)
    if not cameras:
        raise DataError(f"{capture} has no test views, so there is nothing to measure {path.parent} on")
    pruning = model.config.pruning
    return Opened(
        model=model,
        cameras=cameras,
        truths=truths,
        source=path.parent,
        capture=capture,
        scene=(capture.parent if capture.suffix == ".json" else capture).resolve().name,
        method=config.method_name or "",
        variant=config.experiment_name or "",
        keep_ratio=1.0 if pruning.mode == "off" else pruning.keep_ratio,
        seed=config.machine.seed,
        steps=step + 1,
        prune_s=0.0 if pruning.mode == "off" else _prune_seconds(path.parent / "prune.json"),
        curves=path.parent,
    )


def load_run(path: Path) -> Opened:
    """Open a finished run of sundae by its folder or ``config.yml``, and no other method's.

    Raises:
        CheckpointError: there is no such run, it is of another method, or has no whole checkpoint.
        DataError: its capture is gone, or cannot be used, or it was unpacked without one.
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
    return open_run(path)


def _without_extras(stock: SplatfactoModelConfig, field: Path) -> SundaeModelConfig:
    """Configuration of a model of ours that renders a field of splatfacto as splatfacto does."""
    options = {field.name: getattr(stock, field.name) for field in fields(SplatfactoModelConfig) if field.init}
    options.pop("_target")
    # The grid corrects training pictures only; test views are rendered without it.
    options["use_bilateral_grid"] = False
    return SundaeModelConfig(
        **options, pruning=PruningConfig(mode="off"), head=HeadConfig(mode="off"), warm_start=field
    )


def _our_datamanager(stock: FullImageDatamanagerConfig) -> SundaeDatamanagerConfig:
    """Ours, which also works on machines without CUDA, for the same views."""
    options = {field.name: getattr(stock, field.name) for field in fields(FullImageDatamanagerConfig) if field.init}
    options.pop("_target")
    options["train_cameras_sampling_strategy"] = "random"
    return SundaeDatamanagerConfig(**options)


def _capture(config: TrainerConfig, data: Path | None) -> Path:
    """Where the capture is."""
    manager = cast(FullImageDatamanagerConfig, config.pipeline.datamanager)
    said = config.data or manager.data or manager.dataparser.data
    capture = data if data is not None else Path(said)
    if not capture.exists():
        raise DataError(f"the capture {capture} is gone; say with --data where it is now")
    return capture


def views_to_test(model: SundaeModel, datamanager: SundaeDatamanager) -> tuple[list[Cameras], list[Tensor]]:
    """Test cameras and what they photographed, as :class:`Opened` has them."""
    cameras, truths = [], []
    for camera, batch in datamanager.fixed_indices_eval_dataloader:
        cameras.append(camera.to(model.device))
        image = model.get_gt_img(batch["image"])
        truths.append(model.composite_with_background(image, model._get_background_color()))
    return cameras, truths


def _prune_seconds(path: Path) -> float | None:
    try:
        return sum(float(prune["seconds"]) for prune in json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError):
        return None
