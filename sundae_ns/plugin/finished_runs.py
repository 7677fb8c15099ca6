"""Finished scenes as models with test views: runs of sundae or splatfacto, and files in the views of a capture.

A ``config.yml`` can run code in nerfstudio, so no part of it is packed. A packed scene states plain values of its
capture; each one is checked, and a new configuration is made from them.
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.base_datamanager import DataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import CheckpointError, ConfigError, DataError, PackError
from sundae_ns.core.values import usual_defaults
from sundae_ns.data.layouts import posed_layout
from sundae_ns.head.head import HeadConfig
from sundae_ns.io import checkpoint
from sundae_ns.io.config_file import check_run, config_of, load_config
from sundae_ns.io.formats import kind_of, kind_of_gaussians
from sundae_ns.io.run_folder import prunes_of
from sundae_ns.plugin.datamanager import DATASET_FRAME, SundaeDatamanager, SundaeDatamanagerConfig
from sundae_ns.plugin.dataparsers import camera_of, check_capture
from sundae_ns.plugin.model import SundaeModel, SundaeModelConfig
from sundae_ns.rasterize.interface import fastest_device
from sundae_ns.scene.cameras import spread
from sundae_ns.scene.compose import transform
from sundae_ns.scene.load_save import load, no_scene, scene_of_checkpoint
from sundae_ns.scene.packing import refusal
from sundae_ns.scene.scene import Scene, measure, unit
from sundae_ns.train.build import STOCK_ONLY
from sundae_ns.train.pruning import PruningConfig

_PARSERS: dict[str, type[DataParserConfig]] = {
    "blender-data": BlenderDataParserConfig,
    "colmap": ColmapDataParserConfig,
    "nerfstudio-data": NerfstudioDataParserConfig,
}
_ALPHA_COLORS = ("white", "black", None)  # Colours that a packed scene may name for transparent pixels
_FOLDER = re.compile(r"(?!.*\.\.)[\w.-]+(/[\w.-]+)*")
"""Paths that a packed scene may name: below the capture, and without special characters of a shell, because nerfstudio
passes paths of images to ffmpeg through one."""


@dataclass(frozen=True)
class Opened:
    """A finished scene as a model, and the facts in its files; None for what a file does not state."""

    model: SundaeModel  # In evaluation mode, on the GPU if there is one
    datamanager: SundaeDatamanager  # The capture's views, training views too
    source: Path  # The run's folder, or the file
    capture: Path  # The photographs: a folder, or its transforms.json
    method: str
    variant: str
    steps: int  # Number of training steps
    kept: float | None = None  # Ratio of Gaussians after all prunes to those before
    seed: int | None = None
    prune_s: float | None = None  # Seconds of its prunes
    packed_bytes: int | None = None  # Size of the file; None for a run
    pipeline: Any = None  # nerfstudio's pipeline of a run
    cameras: list[Cameras] = field(default_factory=list)  # Test cameras, each of shape (1,), on the model's device
    truths: list[Tensor] = field(default_factory=list)  # True images [H, W, 3] over the model's background, there too

    @property
    def scene(self) -> str:
        """Name of the capture's folder, or of the one around it that ``sundae run`` has made."""
        return next(name for name in self.capture.resolve().parts[::-1] if name != "capture" and name[-5:] != ".json")


@usual_defaults()
def load_model(
    path: Path, data: Path | None = None, *, split: Literal["test", "val"] = "test", like: Opened | None = None
) -> Opened:
    """Open a finished scene as a model, with its test views. No code in its files runs, and they are only read.

    ``path`` is the folder of a run of sundae or splatfacto, its ``config.yml``, or a file of a scene; ``data`` the
    capture, if it has moved, which a file needs. A run of splatfacto becomes a model of ours without a head: one code
    path renders and times all methods. ``split="val"`` opens a run to train on: without test views, and in the state of
    its checkpoint. A file that does not say how its capture is read gets the test views and the background of ``like``.
    ``CheckpointError`` for no such run, one of another method, or without a whole checkpoint; ``DataError`` for a
    missing or unusable capture, or no test views; ``PackError`` for a damaged pack, or impossible values.
    """
    scene = load(path) if kind_of(path) == "packed" or kind_of_gaussians(path) is not None else None
    if scene is not None and like is not None and "capture" not in scene.meta:
        return _in_views_of(like, path, scene)
    if scene is not None:
        opened = _open_file(path, scene, data or (None if like is None else like.capture))
    else:
        if (config := config_of(path)).name != "config.yml" or not config.is_file():
            raise no_scene(path)
        opened = _open_run(config, data, split)
    if split == "test":
        model = opened.model.eval()
        for camera, batch in opened.datamanager.fixed_indices_eval_dataloader:
            opened.cameras.append(camera.to(model.device))
            opened.truths.append(model.truth(batch, {"background": model._get_background_color()}))
    return opened if scene is None or "capture" in scene.meta else _in_views_of(opened, path, scene)


def _in_views_of(like: Opened, path: Path, scene: Scene) -> Opened:
    """A file in the test views of another scene; of the model's and the capture's coordinates, those that fit."""
    device = like.model.device
    subset = slice(None, None, len(like.cameras) // 4 + 1)
    scene = replace(scene, background_color=like.model.config.background_color)
    if not scene.in_model_frame:  # which few formats state
        matrix, scale = like.datamanager.train_dataset.metadata[DATASET_FRAME]
        moved = transform(scene, matrix[:, :3], scale, scale * matrix[:, 3])
        views = like.truths[subset], [like.model.camera_of(camera) for camera in like.cameras[subset]]
        scene = max((scene, moved), key=lambda each: measure(each.to(device), *views).psnr)
    model = model_of(scene).to(device)
    opened = replace(like, model=model, source=path, variant=path.name, packed_bytes=path.stat().st_size)
    return replace(opened, method="", steps=0, kept=None, seed=None, prune_s=None, pipeline=None)


def _open_file(path: Path, scene: Scene, data: Path | None) -> Opened:
    if data is None:
        raise DataError(f"{path} does not name its capture; give the capture with --data")
    config = datamanager_of(scene, data)
    if "capture" not in scene.meta and isinstance(config.dataparser, BlenderDataParserConfig):
        scene = replace(scene, background_color="white")  # as `sundae train` reads this layout
    model = model_of(scene).to(fastest_device())
    manager = config.setup(device=model.device, test_mode="test", world_size=1, local_rank=0)
    source = scene.meta.get("source", {})
    method = str(source.get("method") or "sundae")
    steps = source["step"] + 1 if isinstance(source.get("step"), int) else 0
    return Opened(model, manager, path, data, method, path.name, steps, packed_bytes=path.stat().st_size)


def _open_run(path: Path, data: Path | None, split: Literal["test", "val"]) -> Opened:
    config = _config_of(path)
    newest, loaded = checkpoint.read_newest(path.parent / config.relative_model_dir)
    manager = config.pipeline.datamanager = _datamanager_config(config.pipeline.datamanager)
    stock = config.pipeline.model
    vars(stock).update(dict.fromkeys(STOCK_ONLY, False))  # of training: test views are rendered without them
    if foreign := not isinstance(stock, SundaeModelConfig):
        parts: Any = {"pruning": PruningConfig(mode="off"), "head": HeadConfig(mode="off")}
        config.pipeline.model = SundaeModelConfig(**_shared(stock, SplatfactoModelConfig), **parts)
    # The datamanager's path first: it follows a capture that has moved together with the run.
    capture = data or Path(manager.data or config.data or manager.dataparser.data)
    if not capture.exists():
        raise DataError(f"the capture {capture} is missing; give its folder with --data")
    manager.data = capture
    pipeline: Any = config.pipeline.setup(device=fastest_device(), test_mode=split)
    model = cast(SundaeModel, pipeline.model)
    step = int(loaded["step"])
    if foreign:
        put_scene(model, scene_of_checkpoint(newest, loaded, path))
        model.step = step
    else:
        pipeline.load_pipeline(loaded["pipeline"], step)
    if split == "test":
        pipeline.eval()
    kept, seconds = (1.0, 0.0) if model.config.pruning.mode == "off" else kept_and_seconds(prunes_of(path.parent))
    method, variant = config.method_name or "", config.experiment_name or ""
    opened = Opened(model, pipeline.datamanager, path.parent, capture, method, variant, step + 1)
    return replace(opened, kept=kept, seed=config.machine.seed, prune_s=seconds, pipeline=pipeline)


def _config_of(path: Path) -> TrainerConfig:
    """Configuration of a run of sundae or splatfacto, from its ``config.yml``, which is not run."""
    config = load_config(path)
    model = getattr(getattr(config, "pipeline", None), "model", None)
    if not isinstance(config, TrainerConfig) or not isinstance(model, SplatfactoModelConfig):
        raise CheckpointError(f"{path} is of a method without Gaussians; give a run of sundae or splatfacto")
    return config


def _datamanager_config(stock: DataManagerConfig) -> SundaeDatamanagerConfig:
    """A datamanager of ours, which also works without CUDA, for the same views."""
    if isinstance(stock, SundaeDatamanagerConfig):
        return stock
    shared = _shared(stock, FullImageDatamanagerConfig)
    return SundaeDatamanagerConfig(**{**shared, "train_cameras_sampling_strategy": "random"})


def kept_and_seconds(prunes: list[dict[str, Any]]) -> tuple[float | None, float | None]:
    """Ratio of Gaussians that all prunes kept, and their seconds; None where the record is not whole."""
    kept = seconds = None
    if prunes:
        with suppress(KeyError, TypeError, ArithmeticError):
            kept = math.prod(prune["after"] / prune["before"] for prune in prunes)
        with suppress(KeyError, TypeError, ValueError, ArithmeticError):
            seconds = sum(float(prune["seconds"]) for prune in prunes)
    return kept, seconds


def _shared(config: Any, kind: type[Any]) -> dict[str, Any]:
    return {known.name: getattr(config, known.name) for known in fields(kind) if known.init and known.name != "_target"}


def model_of(scene: Scene) -> SundaeModel:
    """The model of a scene in evaluation mode, on the CPU, with all SH degrees and the head enabled."""
    degree = 0 if scene.gaussians.encoding == "logits" else max(scene.gaussians.sh_degree, 1)
    head = HeadConfig(mode="off") if scene.head is None else replace(scene.head.config, start_at=0)
    look: Any = {"rasterize_mode": "antialiased" if scene.antialiased else "classic"}
    look |= {"background_color": scene.background_color, "sh_degree": degree, "sh_degree_interval": 1}
    config = SundaeModelConfig(head=head, **look)
    config.camera_optimizer.mode = "off"
    # Two points; without any, the model would start from tens of thousands of random points.
    seeds = (torch.eye(3)[:2], torch.zeros(2, 3))
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model: SundaeModel = config.setup(scene_box=box, num_train_data=0, metadata={}, seed_points=seeds)
    put_scene(model, scene)
    model.step = max(degree, 1)  # at which all SH degrees are active and the head is enabled
    return model.eval()


def put_scene(model: SundaeModel, scene: Scene) -> None:
    """Load a scene into a model in place; the model has its SH degree or more, and a head of its kind."""
    put_gaussians(model, scene.gaussians)
    if model.head is not None and scene.head is not None:
        model.head.load_state_dict(scene.head.state_dict())
    model.state.trained_focal = scene.trained_focal


def put_gaussians(model: SundaeModel, gaussians: Mapping[str, Tensor]) -> None:
    """Load Gaussians into a model in place; parameters and coefficients that they lack become 0."""
    for name, value in model.gauss_params.items():
        new = value.data.new_zeros(len(gaussians["means"]), *value.shape[1:])
        if name in gaussians:
            new[:, : gaussians[name].shape[1]] = gaussians[name].detach().to(new)
        value.data = new


@usual_defaults()
def load_run(run: Path, *, max_cameras: int = 100, data: Path | None = None) -> Scene:
    """The scene of a finished run with at most ``max_cameras`` training cameras, and how its capture is read.

    Arguments and errors are those of :func:`load_model`; with 0 cameras the capture is not needed.
    """
    check_run(run)
    path = config_of(run)
    config, scene = _config_of(path), load(path)
    manager = _datamanager_config(copy.deepcopy(config.pipeline.datamanager))
    manager.data = data or manager.data or config.data
    source = {"method": config.method_name, **scene.meta["source"]}
    meta = {**scene.meta, "source": source, "capture": describe_capture(manager)}
    cameras, up = tuple[Camera, ...](), scene.up
    if max_cameras > 0:
        views: Cameras = manager.setup(device="cpu", test_mode="test").train_dataset.cameras
        cameras = tuple(camera_of(views[i : i + 1], "cpu") for i in spread(len(views), max_cameras))
    if up is None and cameras:
        with suppress(ConfigError):  # cameras that look all around have none
            up = unit(torch.stack([camera.pose[:, 1] for camera in cameras]).double().mean(dim=0).tolist())
    return replace(scene, cameras=cameras, up=up, meta=meta)


def describe_capture(manager: SundaeDatamanagerConfig) -> dict[str, Any] | None:
    """Plain values to parse, split and scale the same capture again; None where :func:`stated_capture` refuses them."""
    parser = manager.dataparser
    if (kind := next((name for name, known in _PARSERS.items() if type(parser) is known), None)) is None:
        return None
    options = {name: getattr(parser, name, default) for name, default in _parser_options(_PARSERS[kind]).items()}
    options = {name: value.as_posix() if isinstance(value, Path) else value for name, value in options.items()}
    stated = {"parser": kind, "options": options, "scale": manager.camera_res_scale_factor}
    with suppress(PackError):
        stated_capture(stated)
        return {**stated, "robust_frame": True} if manager.robust_frame else stated
    return None


def _parser_options(kind: type[DataParserConfig]) -> dict[str, Any]:
    """Options of a parser that a finished run needs, with their defaults."""
    left_out = {"_target", "data", "masks_path", "depths_path", "mask_color", "load_3D_points", "ply_path"}
    return {option.name: getattr(kind(), option.name) for option in fields(kind) if option.name not in left_out}


def datamanager_of(scene: Scene, data: Path) -> SundaeDatamanagerConfig:
    """Configuration that parses, splits and scales a capture as in the training of a scene, else by its layout.

    ``DataError`` if the capture cannot be used, ``PackError`` if the scene states the impossible.
    """
    shape: Any = {}
    if "capture" in scene.meta:
        stated = scene.meta["capture"]
        parser, scale = stated_capture(stated)
        shape = {"camera_res_scale_factor": scale, "robust_frame": stated.get("robust_frame") is True}
    else:
        layout = posed_layout(data)
        kind, *words = ["nerfstudio-data"] if layout is None else layout.words
        parser = tyro.cli(_PARSERS[kind], args=words)
    check_capture(parser, data, ("train", "test"))
    return SundaeDatamanagerConfig(dataparser=parser, data=data.resolve(), cache_images_type="uint8", **shape)


def stated_capture(stated: Any) -> tuple[DataParserConfig, float]:
    """Counterpart of :func:`describe_capture`: the parser, and the scale of its images."""
    stated = stated if isinstance(stated, dict) else {}
    kind, options, scale = (stated.get(name) for name in ("parser", "options", "scale"))
    if kind not in _PARSERS or not isinstance(options, dict):
        raise PackError("the packed scene does not say how its capture is read; measure the run that was packed")
    if type(scale) not in (int, float) or not 0 < scale <= 1:
        raise refusal("an impossible scale of its images")
    parser: Any = _PARSERS[kind]()
    if hasattr(parser, "load_3D_points"):
        parser.load_3D_points = False
    known, hints = _parser_options(_PARSERS[kind]), get_type_hints(_PARSERS[kind])
    for name, value in options.items():
        if name not in known or not _is_possible(value, known[name], hints[name]):
            raise refusal(f"an impossible option {str(name)[:40]!r} of its capture")
        setattr(parser, name, Path(value) if isinstance(known[name], Path) else value)
    return parser, float(scale)


def _is_possible(value: Any, default: Any, hint: Any) -> bool:
    """Whether a value of JSON can stand for an option with this default and type."""
    if default is None:
        return value is None or (type(value) is int and value > 0)
    if isinstance(default, Path):
        return isinstance(value, str) and _FOLDER.fullmatch(value) is not None
    if isinstance(default, float):
        return type(value) in (int, float) and abs(value) < 1e308  # float64 holds it
    if isinstance(default, str):
        return value in (get_args(hint) if get_origin(hint) is Literal else _ALPHA_COLORS)
    return type(value) is type(default)
