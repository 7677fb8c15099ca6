"""Finished runs as packed scenes, and packed scenes as models with the views of their captures.

A ``config.yml`` can run code in nerfstudio, so no part of it is packed. A packed scene states plain values; each one is
checked, and a new configuration is made from them.
"""

from __future__ import annotations

import copy
import dataclasses
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from torch import Tensor

from sundae_ns.api.files import load
from sundae_ns.api.packing import contents_of, refusal, scene_of
from sundae_ns.api.scene import Scene
from sundae_ns.api.views import is_number, unit
from sundae_ns.compensation import HeadConfig
from sundae_ns.datamanager import SundaeDatamanagerConfig
from sundae_ns.errors import ConfigError, PackError
from sundae_ns.model import SundaeModel, SundaeModelConfig
from sundae_ns.parsing import check_capture
from sundae_ns.scenes import stock
from sundae_ns.storage.pack import PackedScene, fit_scene, pack_bytes
from sundae_ns.storage.runs.config_file import check_run
from sundae_ns.storage.runs.folder import config_of

_PARSERS: dict[str, type[DataParserConfig]] = {
    "blender-data": BlenderDataParserConfig,
    "colmap": ColmapDataParserConfig,
    "nerfstudio-data": NerfstudioDataParserConfig,
}
_ALPHA_COLORS = ("white", "black", None)
"""Colours that a packed scene may name for what is transparent in its images."""
_FOLDER = re.compile(r"(?!.*\.\.)[\w.-]+(/[\w.-]+)*")
"""Paths that a packed scene may name: below the capture, and without special characters of a shell, because nerfstudio
passes paths of images to ffmpeg through one."""


def contents_of_run(run: Path, *, max_cameras: int = 100, data: Path | None = None) -> PackedScene:
    """The contents of a packed file for a finished run: field, head if it is enabled, and some training cameras.

    SH coefficients that were not trained yet are left out, and so are the features of a disabled head.

    Args:
        run: folder of a run of sundae or splatfacto, or its ``config.yml``, which is not run.
        max_cameras: highest number of training cameras, evenly chosen; with 0 the capture is not needed.
        data: the capture, if it has moved.

    Raises:
        CheckpointError: there is no such run, it is of another method, or has no whole checkpoint.
        DataError: its capture is gone, or cannot be used.
    """
    check_run(run)
    path = config_of(run)
    config, _ = stock.config_with_field(path)
    scene = load(path)
    manager = stock.datamanager_config(copy.deepcopy(config.pipeline.datamanager))
    manager.data = data or manager.data or config.data
    source = {"method": config.method_name, **scene.meta["source"]}
    meta = {**scene.meta, "source": source, "capture": _describe(manager)}
    cameras = _cameras(manager, max_cameras) if max_cameras > 0 else None
    up = scene.up
    if up is None and cameras is not None:
        with suppress(ConfigError):  # cameras that look all around have none
            up = unit(cameras["poses"][:, :, 1].double().mean(dim=0).tolist())
    return contents_of(dataclasses.replace(scene, meta=meta, up=up), cameras)


def packed_run(run: Path, *, data: Path | None = None) -> tuple[Scene, bytes]:
    """The scene of a finished run with its training cameras, and its packed file; errors as :func:`contents_of_run`."""
    contents = contents_of_run(run, data=data)
    return scene_of(contents), pack_bytes(*fit_scene(contents))[0]


def _cameras(manager: SundaeDatamanagerConfig, most: int) -> dict[str, Tensor]:
    cameras: Cameras = manager.setup(device="cpu", test_mode="test").train_dataset.cameras
    chosen = torch.linspace(0, len(cameras) - 1, min(most, len(cameras))).round().long()
    return {
        "poses": cameras.camera_to_worlds[chosen],
        "intrinsics": torch.cat([cameras.fx, cameras.fy, cameras.cx, cameras.cy], dim=-1)[chosen].double(),
        "sizes": torch.cat([cameras.width, cameras.height], dim=-1)[chosen],
    }


def _describe(manager: SundaeDatamanagerConfig) -> dict[str, Any] | None:
    """Plain values to parse, split and scale the same capture again; None for another parser."""
    parser = manager.dataparser
    kind = next((name for name, known in _PARSERS.items() if type(parser) is known), None)
    if kind is None:
        return None
    options: dict[str, Any] = {}
    for name, default in _options(_PARSERS[kind]).items():
        value = getattr(parser, name, default)
        if isinstance(value, Path):
            value = value.as_posix()
        if isinstance(value, str) and isinstance(default, Path) and not _FOLDER.fullmatch(value):
            return None  # outside of the capture
        if name == "alpha_color" and value not in _ALPHA_COLORS:
            return None
        options[name] = value
    stated = {"parser": kind, "options": options, "scale": manager.camera_res_scale_factor}
    return {**stated, "robust_frame": True} if manager.robust_frame else stated


def _options(kind: type[DataParserConfig]) -> dict[str, Any]:
    """Options of a parser that a finished run needs, with their defaults."""
    left_out = {"_target", "data", "masks_path", "depths_path", "mask_color", "load_3D_points", "ply_path"}
    return {field.name: getattr(kind(), field.name) for field in fields(kind) if field.name not in left_out}


def model_of(scene: Scene) -> SundaeModel:
    """The model of a scene in evaluation mode, on the CPU, with all SH degrees and the head enabled."""
    degree = 0 if scene.field.encoding == "logits" else max(scene.field.sh_degree, 1)
    head = HeadConfig(mode="off") if scene.head is None else dataclasses.replace(scene.head.config, start_at=0)
    config = SundaeModelConfig(
        sh_degree=degree,
        sh_degree_interval=1,
        rasterize_mode="antialiased" if scene.antialiased else "classic",
        background_color=scene.background_color,
        head=head,
    )
    config.camera_optimizer.mode = "off"
    # Two points; without any, the model would start from tens of thousands of random points.
    seeds = (torch.eye(3)[:2], torch.zeros(2, 3))
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model: SundaeModel = config.setup(scene_box=box, num_train_data=0, metadata={}, seed_points=seeds)
    put_scene(model, scene)
    # A step at which all SH degrees are active and the head is enabled.
    model.step = max(degree, 1)
    return model.eval()


def put_scene(model: SundaeModel, scene: Scene) -> None:
    """Put a finished scene in place of a model's field and head.

    Args:
        model: of at least the scene's SH degree, and with a head of its kind if the scene has one.
        scene: any device.
    """
    place(model, scene.field)
    if model.head is not None and scene.head is not None:
        model.head.load_state_dict(scene.head.state_dict())
    model.state.trained_focal = scene.trained_focal


def place(model: SundaeModel, field: Mapping[str, Tensor]) -> None:
    """Load a field into a model in place; parameters and coefficients that the field lacks become 0."""
    for name, value in model.gauss_params.items():
        new = value.data.new_zeros(len(field["means"]), *value.shape[1:])
        if name in field:
            new[:, : field[name].shape[1]] = field[name].detach().to(new)
        value.data = new


def datamanager_of(packed: PackedScene, data: Path) -> SundaeDatamanagerConfig:
    """Configuration that parses, splits and scales a capture as in the training of a packed scene.

    Raises:
        DataError: the capture is missing, or cannot be used.
        PackError: the scene does not say how its capture is read, or states something impossible.
    """
    stated: Any = packed.meta.get("capture")
    parser, scale = _capture(stated)
    check_capture(parser, data, ("train", "test"))
    return SundaeDatamanagerConfig(
        dataparser=parser,
        camera_res_scale_factor=scale,
        data=data.resolve(),
        cache_images_type="uint8",
        robust_frame=stated.get("robust_frame") is True,
    )


def _capture(stated: Any) -> tuple[DataParserConfig, float]:
    """Counterpart of :func:`_describe`: the parser, and the scale of its images."""
    kind = stated.get("parser") if isinstance(stated, dict) else None
    options = stated.get("options") if isinstance(stated, dict) else None
    if kind not in _PARSERS or not isinstance(options, dict):
        raise PackError("the packed scene does not say how its capture is read; measure the run that was packed")
    scale = stated.get("scale")
    if not is_number(scale) or not 0 < scale <= 1:
        raise refusal("an impossible scale of its images")
    parser: Any = _PARSERS[kind]()
    if hasattr(parser, "load_3D_points"):
        parser.load_3D_points = False
    known, hints = _options(_PARSERS[kind]), get_type_hints(_PARSERS[kind])
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
        return is_number(value)
    if isinstance(default, str):
        return value in (get_args(hint) if get_origin(hint) is Literal else _ALPHA_COLORS)
    return type(value) is type(default)
