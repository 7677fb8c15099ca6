"""Between scenes and the contents of packed files. What a file states is checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args, get_type_hints

import torch
from torch import Tensor

from sundae_ns.api.scene import Background, Scene
from sundae_ns.api.sensitivity import sensitivity_of
from sundae_ns.api.views import is_frame, is_number, view_in_front
from sundae_ns.compensation import CompensationHead, HeadConfig
from sundae_ns.errors import PackError, SundaeError
from sundae_ns.gaussians import FEATURES
from sundae_ns.gaussians.field import Field
from sundae_ns.gaussians.parameters import MAX_SH_DEGREE
from sundae_ns.rendering.views import View
from sundae_ns.storage.packing import PackedScene

_KINDS = get_type_hints(HeadConfig)
_HEAD_VALUES: dict[str, Sequence[Any]] = {
    "mode": get_args(_KINDS["mode"]),
    "size": get_args(_KINDS["size"]),
    "pixel_unshuffle": range(1, 9),
    "num_features": range(1, 257),
    "precision": get_args(_KINDS["precision"]),
}
"""Options of a head that a packed scene states, and their values."""
_RASTERIZE_MODES = ("classic", "antialiased")
_MODEL_VALUES: dict[str, Sequence[Any]] = {
    "sh_degree": range(MAX_SH_DEGREE + 1),
    "background_color": get_args(Background),
    "rasterize_mode": _RASTERIZE_MODES,
}
"""Options of a model that a packed scene states, and their values."""
_CARRIED = ("source", "frame", "capture")
"""Entries of the header that a scene carries along."""


def scene_of(packed: PackedScene) -> Scene:
    """The scene of a packed file's contents, on the CPU.

    Raises:
        PackError: the contents state an impossible model, or another head than they have.
    """
    stated = packed.meta.get("model")
    if not isinstance(stated, dict):
        raise refusal("no model")
    degree, background, rasterize_mode = _checked(stated, _MODEL_VALUES)
    if packed.field["features_rest"].shape[1] > (degree + 1) ** 2 - 1:
        raise refusal("a lower SH degree than it has")
    meta = {name: packed.meta[name] for name in _CARRIED if packed.meta.get(name) is not None}
    if not is_frame(meta.get("frame")):
        meta.pop("frame", None)
    source = meta.get("source")
    return Scene(
        Field(dict(packed.field), "logits" if degree == 0 else "harmonics"),
        _head_of(packed, stated.get("head")),
        background_color=background,
        antialiased=rasterize_mode == "antialiased",
        trained_focal=_focal(stated.get("trained_focal")),
        views=views_of_arrays(packed.cameras),
        in_model_frame=not isinstance(source, dict) or source.get("model_frame") is not False,
        meta=meta,
    )


def contents_of(scene: Scene, cameras: Mapping[str, Tensor] | None = None) -> PackedScene:
    """The contents of a packed file for a scene, with how much errors are seen in its cameras.

    Args:
        scene: any device; its primitives must be finite.
        cameras: arrays by the names of :data:`sundae_ns.storage.packing.scene.CAMERAS`; by default those of the
            scene's views.
    """
    scene = scene.to("cpu")
    head = {} if scene.head is None else dict(scene.head.state_dict())
    field = {name: value.detach() for name, value in scene.field.items() if name != FEATURES or head}
    if cameras is None and scene.views:
        cameras = arrays_of_views(scene.views)
    options = None if scene.head is None else {name: getattr(scene.head.config, name) for name in _HEAD_VALUES}
    # Degree 0 stands for logits.
    degree = 0 if scene.field.encoding == "logits" else max(scene.field.sh_degree, 1)
    model = {
        "sh_degree": degree,
        "rasterize_mode": _RASTERIZE_MODES[scene.antialiased],
        "background_color": scene.background_color,
        "head": options,
        "trained_focal": list(scene.trained_focal) if head and scene.trained_focal else None,
    }
    source = {**scene.meta.get("source", {}), **({} if scene.in_model_frame else {"model_frame": False})}
    meta = {**scene.meta, "source": source, "model": model}
    views = views_of_arrays(cameras)
    return PackedScene(
        field, head, None if cameras is None else dict(cameras), meta, sensitivity_of(scene, views) if views else None
    )


def stored_cameras(packed: PackedScene) -> dict[str, Tensor]:
    """The stored cameras, as arrays; one in front of the scene if there are none."""
    if packed.cameras is not None and len(packed.cameras["poses"]):
        return packed.cameras
    return arrays_of_views([view_in_front(scene_of(packed))])


def views_of_arrays(cameras: Mapping[str, Tensor] | None) -> tuple[View, ...]:
    """Cameras of a packed file as views, on the CPU; none for None."""
    if cameras is None:
        return ()
    rows = zip(cameras["poses"], cameras["intrinsics"].tolist(), cameras["sizes"].tolist(), strict=True)
    return tuple(View.from_pose(pose, intrinsics, *size) for pose, intrinsics, size in rows)


def arrays_of_views(views: Sequence[View]) -> dict[str, Tensor]:
    """Counterpart of :func:`views_of_arrays`."""
    return {
        "poses": torch.stack([view.pose for view in views]).cpu(),
        "intrinsics": torch.stack([view.K[[0, 1, 0, 1], [0, 1, 2, 2]] for view in views]).double().cpu(),
        "sizes": torch.tensor([[view.width, view.height] for view in views]),
    }


def _head_of(packed: PackedScene, stated: Any) -> CompensationHead | None:
    features = packed.field[FEATURES].shape[1] if FEATURES in packed.field else 0
    config = HeadConfig(mode="off")
    if stated is not None:
        if not isinstance(stated, dict) or set(stated) != set(_HEAD_VALUES):
            raise refusal("a head of an unknown kind")
        config = HeadConfig(**dict(zip(_HEAD_VALUES, _checked(stated, _HEAD_VALUES), strict=True)), start_at=0)
    if config.mode == "off" and not packed.head and features == 0:
        return None
    if features != config.num_features:
        raise refusal("another number of features than it has")
    try:
        head = CompensationHead(config)
        head.load_state_dict(packed.head)
    except (SundaeError, RuntimeError) as error:
        raise refusal("another head than it has") from error
    return head.eval()


def refusal(reason: str) -> PackError:
    """The error of a scene that states something impossible."""
    return PackError(f"the packed scene states {reason}; update this program, or pack it again")


def _checked(stated: Mapping[str, Any], values: Mapping[str, Sequence[Any]]) -> list[Any]:
    """The stated options, in the order of ``values``.

    Raises:
        PackError: an option is none of its values.
    """
    for name, known in values.items():
        value = stated.get(name)
        # By type too: True is 1 and 1.0 is 1 in Python.
        if type(value) is not type(known[0]) or value not in known:
            allowed = f"{known[0]} to {known[-1]}" if isinstance(known, range) else ", ".join(known)
            raise refusal(f"a {name} that is none of {allowed}")
    return [stated[name] for name in values]


def _focal(stated: Any) -> tuple[float, float] | None:
    if stated is None:
        return None
    if not isinstance(stated, list) or len(stated) != 2 or not all(is_number(v) and v > 0 for v in stated):
        raise refusal("impossible focal lengths")
    return float(stated[0]), float(stated[1])
