"""The model and the cameras that a packed scene states, checked, without nerfstudio."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_type_hints

import torch
from torch import Tensor

from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.data.camera_axes import world_to_camera
from sundae_ns.errors import PackError, SundaeError
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.field import Field
from sundae_ns.rasterization import Backend
from sundae_ns.rendering.render import SHOWN_BACKGROUNDS, RenderSettings
from sundae_ns.rendering.views import View
from sundae_ns.storage.packing import Scene

HEAD_OPTIONS = ("mode", "size", "pixel_unshuffle", "num_features", "precision")
"""Options of a head that a packed scene states."""
_MOST_UNSHUFFLE = 8


@dataclass(frozen=True)
class StatedModel:
    """Options of the model of a packed scene."""

    sh_degree: int
    rasterize_mode: Literal["classic", "antialiased"]
    background_color: Literal["random", "black", "white"]
    head: HeadConfig
    """Mode off without a head."""
    trained_focal: tuple[float, float] | None
    """Shortest and longest focal length of the images that the head was trained on, pixels."""

    @property
    def background(self) -> Tensor:
        """Colour ``[3]`` behind the scene, on the CPU."""
        return torch.tensor(SHOWN_BACKGROUNDS[self.background_color])

    def settings(self, backend: Backend, head: CompensationHead | None) -> RenderSettings:
        """Settings that render the scene, all SH degrees included."""
        antialiased = self.rasterize_mode == "antialiased"
        return RenderSettings(backend, antialiased=antialiased, head=head, trained_focal=self.trained_focal)


def stated_model(scene: Scene) -> StatedModel:
    """Options of the scene's model.

    Raises:
        PackError: they are missing or impossible.
    """
    stated = scene.meta.get("model")
    if not isinstance(stated, dict):
        raise refusal("no model")
    model = StatedModel(
        sh_degree=_whole(stated, "sh_degree", 0, 4),
        rasterize_mode=_one_of(stated, StatedModel, "rasterize_mode"),
        background_color=_one_of(stated, StatedModel, "background_color"),
        head=_head_config(stated.get("head")),
        trained_focal=_focal(stated.get("trained_focal")),
    )
    if scene.field["features_rest"].shape[1] > (model.sh_degree + 1) ** 2 - 1:
        raise refusal("a lower SH degree than it has")
    return model


def field_of(scene: Scene) -> Field:
    """The primitives of a scene, as they are stored.

    Raises:
        PackError: the scene states an impossible model.
    """
    return Field(dict(scene.field), "logits" if stated_model(scene).sh_degree == 0 else "harmonics")


def head_of(scene: Scene) -> CompensationHead | None:
    """The head of a scene, or None for a scene without one.

    Raises:
        PackError: the scene states another head than it has, or an impossible model.
    """
    config = stated_model(scene).head
    features = scene.field[FEATURES].shape[1] if FEATURES in scene.field else 0
    if config.mode == "off" and not scene.head and features == 0:
        return None
    if features != config.num_features:
        raise refusal("another number of features than it has")
    try:
        head = CompensationHead(config)
        head.load_state_dict(scene.head)
    except (SundaeError, RuntimeError) as error:
        raise refusal("another head than it has") from error
    return head.eval()


def cameras_of(scene: Scene) -> dict[str, Tensor]:
    """The cameras of a scene by the names of ``storage.packing.CAMERAS``; one in front of it if it has none."""
    if scene.cameras is None or len(scene.cameras["poses"]) == 0:
        return _outside_camera(scene.field["means"])
    return scene.cameras


def stored_view(cameras: Mapping[str, Tensor], index: int, device: torch.device | str = "cpu") -> View:
    """A stored camera in the rasteriser's form."""
    fx, fy, cx, cy = cameras["intrinsics"][index].tolist()
    width, height = cameras["sizes"][index].tolist()
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], device=device)
    viewmat = world_to_camera(cameras["poses"][index].float()).to(device)
    return View(viewmat, K, width, height, (fx + fy) / 2)


def refusal(reason: str) -> PackError:
    """The error of a scene that states something impossible."""
    return PackError(f"the packed scene states {reason}; update this program, or pack it again")


def choices(kind: type, name: str) -> tuple[Any, ...]:
    """The values that an option may have."""
    return get_args(get_type_hints(kind)[name])


def is_number(value: Any) -> bool:
    """Whether a value of JSON is a finite number."""
    return type(value) in (int, float) and math.isfinite(value)


def _one_of(stated: Mapping[str, Any], kind: type, name: str) -> Any:
    value, known = stated.get(name), choices(kind, name)
    if value not in known:
        raise refusal(f"a {name} that is none of {', '.join(map(str, known))}")
    return value


def _whole(stated: Mapping[str, Any], name: str, least: int, most: int) -> int:
    value = stated.get(name)
    if type(value) is not int or not least <= value <= most:
        raise refusal(f"a {name} outside of {least} to {most}")
    return value


def _head_config(stated: Any) -> HeadConfig:
    if stated is None:
        return HeadConfig(mode="off")
    if not isinstance(stated, dict) or set(stated) != set(HEAD_OPTIONS):
        raise refusal("a head of an unknown kind")
    return HeadConfig(
        mode=_one_of(stated, HeadConfig, "mode"),
        size=_one_of(stated, HeadConfig, "size"),
        precision=_one_of(stated, HeadConfig, "precision"),
        pixel_unshuffle=_whole(stated, "pixel_unshuffle", 1, _MOST_UNSHUFFLE),
        num_features=_whole(stated, "num_features", 1, 256),
        start_at=0,
    )


def _focal(stated: Any) -> tuple[float, float] | None:
    if stated is None:
        return None
    if not isinstance(stated, list) or len(stated) != 2 or not all(is_number(v) and v > 0 for v in stated):
        raise refusal("impossible focal lengths")
    return float(stated[0]), float(stated[1])


def _outside_camera(means: Tensor) -> dict[str, Tensor]:
    """A camera in front of a scene without cameras: it looks along y, with z upwards."""
    center = means.median(dim=0).values
    away = 3 * (means - center).norm(dim=1).median().clamp_min(1e-6)
    pose = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    pose[:, 3] = center + pose[:, 2] * away
    return {
        "poses": pose[None],
        "intrinsics": torch.tensor([[500.0, 500.0, 320.0, 240.0]]).double(),
        "sizes": torch.tensor([[640, 480]]),
    }
