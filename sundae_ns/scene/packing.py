"""Between scenes and the contents of packed files. What a file states is checked."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from sundae_ns.core.camera import View
from sundae_ns.core.errors import ConfigError, PackError
from sundae_ns.core.gaussians import FEATURES, Field, mend
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.io.pack.codecs import Sensitivity
from sundae_ns.io.pack.container import FORMAT, fault
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, pack_bytes
from sundae_ns.rasterize.reference import harmonic_basis
from sundae_ns.scene.cameras import Direction, is_frame, unit
from sundae_ns.scene.render import LocalField, render_view
from sundae_ns.scene.scene import Scene

_MODEL: dict[str, Any] = FORMAT["model"]
_PROPERTIES: dict[str, Any] = FORMAT["header"]["properties"]


def scene_of(packed: PackedScene) -> Scene:
    """The scene of a packed file's contents, on the CPU.

    Raises:
        PackError: the contents state an impossible model, or another head than they have.
    """
    stated: dict[str, Any] = packed.meta.get("model")  # type: ignore[assignment]
    wrong = fault(stated, _MODEL, "model")
    if wrong is not None:
        raise refusal(f"no valid {wrong}")
    degree, focal = int(stated["sh_degree"]), stated.get("trained_focal")
    if packed.field["features_rest"].shape[1] > (degree + 1) ** 2 - 1:
        raise refusal("a lower SH degree than it has")
    meta = {name: packed.meta[name] for name in ("source", "frame", "capture") if packed.meta.get(name) is not None}
    if not is_frame(meta.get("frame")):
        meta.pop("frame", None)
    source = meta.get("source")
    up, start = start_of(packed.meta)
    return Scene(
        Field(dict(packed.field), "logits" if degree == 0 else "harmonics"),
        _head_of(packed, stated.get("head")),
        background_color=stated["background_color"],
        antialiased=stated["rasterize_mode"] == "antialiased",
        trained_focal=None if focal is None else (float(focal[0]), float(focal[1])),
        views=views_of_arrays(packed.cameras),
        up=up,
        start=start,
        in_model_frame=not isinstance(source, dict) or source.get("model_frame") is not False,
        meta=meta,
    )


def contents_of(scene: Scene) -> PackedScene:
    """The contents of a packed file for a scene on any device, with how much errors are seen in its views.

    Primitives that are not finite are left out (``gaussians.mend``).
    """
    scene = scene.to("cpu")
    scene = replace(scene, field=mend(scene.field).field)
    head = {} if scene.head is None else dict(scene.head.state_dict())
    field = {name: value.detach() for name, value in scene.field.items() if name != FEATURES or head}
    stated = _MODEL["properties"]["head"]["required"]
    options = None if scene.head is None else {name: getattr(scene.head.config, name) for name in stated}
    # Degree 0 stands for logits.
    degree = 0 if scene.field.encoding == "logits" else max(scene.field.sh_degree, 1)
    model = {
        "sh_degree": degree,
        "rasterize_mode": "antialiased" if scene.antialiased else "classic",
        "background_color": scene.background_color,
        "head": options,
        "trained_focal": list(scene.trained_focal) if head and scene.trained_focal else None,
    }
    source = {**scene.meta.get("source", {}), **({} if scene.in_model_frame else {"model_frame": False})}
    meta = {**scene.meta, "source": source, "model": model, **stated_start(scene)}
    if not scene.views:
        return PackedScene(field, head, None, meta, None)
    return PackedScene(field, head, arrays_of_views(scene.views), meta, sensitivity_of(scene, scene.views))


def packed_bytes(scene: Scene) -> bytes:
    """The packed file of a scene, with default settings."""
    return pack_bytes(*fit_scene(contents_of(scene)))[0]


def stated_start(scene: Scene) -> dict[str, Any]:
    """Entries ``up`` and ``start`` of a packed file's header; without those that the scene does not know.

    Raises:
        ConfigError: readers would refuse them.
    """
    stated: dict[str, Any] = {}
    if scene.up is not None:
        stated["up"] = [float(value) for value in scene.up]
    if scene.start is not None:
        view = scene.start
        stated["start"] = {
            "pose": view.pose.double().tolist(),
            "intrinsics": view.K.double()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
            "size": [view.width, view.height],
        }
    for name, value in stated.items():
        finite = not re.search("NaN|Infinity", json.dumps(value))
        if not finite or fault(value, _PROPERTIES[name]) is not None:
            named = "start view" if name == "start" else "up axis"
            raise ConfigError(f"the {named} of the scene has values that readers refuse; give another one")
    return stated


def start_of(stated: Mapping[str, Any]) -> tuple[Direction | None, View | None]:
    """Up axis and start view of JSON values; None for one that is missing, or that the schema refuses."""
    names = [name for name in ("up", "start") if name in stated and fault(stated[name], _PROPERTIES[name]) is None]
    good = {name: stated[name] for name in names}
    view = None
    if "start" in good:
        start = good["start"]
        view = View.from_pose(torch.tensor(start["pose"], dtype=torch.float64), start["intrinsics"], *start["size"])
    return unit(good["up"]) if "up" in good else None, view


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


def _head_of(packed: PackedScene, stated: Mapping[str, Any] | None) -> CompensationHead | None:
    features = packed.field[FEATURES].shape[1] if FEATURES in packed.field else 0
    if stated is None and not packed.head and features == 0:
        return None
    if stated is None or features != stated["num_features"]:
        raise refusal("another number of features than it has")
    whole = {name: int(stated[name]) for name in ("pixel_unshuffle", "num_features")}
    config = HeadConfig(**{**stated, **whole}, start_at=0)
    head = CompensationHead.of_weights(config, packed.head)
    if head is None:
        raise refusal("another head than it has")
    return head


def refusal(reason: str) -> PackError:
    """The error of a scene that states something impossible."""
    return PackError(f"the packed scene states {reason}; update this program, or pack it again")


def sensitivity_of(scene: Scene, views: Sequence[View]) -> Sensitivity:
    """Effect of quantisation errors on images, which decides where a pack spends its bits.

    A camera sees a primitive from few directions, so some combinations of harmonics hardly show. Weights of the head
    differ more: those of its finest level act on 64 times as many pixels as those of its coarsest. Derivatives of all
    pixels are too many. With random signs r of the pixels, the mean square of the derivative of sum(r * image) is the
    sum of the squared derivatives (Hutchinson, 1990). Views and signs are fixed, so that a run packs alike each time.

    Args:
        scene: on the CPU.
        views: at least one.
    """
    rows = {}
    degree = scene.field.sh_degree if scene.field.encoding == "harmonics" else 0
    if degree > 0:
        rows["features_rest"] = torch.kron(_of_harmonics(scene.field["means"].detach(), views, degree), torch.eye(3))
    head: dict[str, Tensor] = {}
    if scene.head is not None:
        rows[FEATURES], head = _of_head(scene, views)
    return Sensitivity(rows, head)


def _of_harmonics(means: Tensor, views: Sequence[View], degree: int) -> Tensor:
    """Sum of the products of basis functions of degrees 1 and up, over views and the primitives they see ``[K, K]``."""
    chosen = means[:: -(-len(means) // (1 << 14))]
    total = torch.zeros((degree + 1) ** 2 - 1, (degree + 1) ** 2 - 1, dtype=torch.float64)
    for view in views:
        x, y, z = (chosen @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).T
        across, down = x / z * view.K[0, 0] + view.K[0, 2], y / z * view.K[1, 1] + view.K[1, 2]
        seen = chosen[(z > 0) & (across >= 0) & (across < view.width) & (down >= 0) & (down < view.height)]
        basis = harmonic_basis(degree, torch.nn.functional.normalize(seen - view.center, dim=1))[:, 1:].double()
        total += basis.T @ basis
    # A little of the identity: a form without any view is singular.
    return total + 1e-6 * (1 + total.trace()) * torch.eye(len(total), dtype=torch.float64)


@torch.enable_grad()  # type: ignore[untyped-decorator]
def _of_head(scene: Scene, views: Sequence[View]) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean products of the derivatives by pairs of features ``[F, F]``, and mean squares of those by weights."""
    assert scene.head is not None
    features = scene.field[FEATURES].detach().requires_grad_()
    source = LocalField(scene.field.replaced({FEATURES: features}))
    settings = replace(scene.settings(), training=True)
    weights = {name: value.requires_grad_() for name, value in scene.head.named_parameters() if value.ndim > 1}
    form = torch.zeros(features.shape[1], features.shape[1], dtype=torch.float64)
    squares = {name: torch.zeros(value.shape[:2], dtype=torch.float64) for name, value in weights.items()}
    signs = torch.Generator().manual_seed(0)
    for i in torch.linspace(0, len(views) - 1, min(8, len(views))).round().int().tolist():
        view = views[i]
        if view.width * view.height > 1 << 17:
            view = view.zoomed((1 << 17 / (view.width * view.height)) ** 0.5)
        image = render_view(source, view, scene.background, settings, depth=False)[0]["rgb"]
        random = torch.randint(0, 2, image.shape, generator=signs) * 2.0 - 1
        of_features, *grads = torch.autograd.grad((image * random).sum(), [features, *weights.values()])
        form += of_features.double().T @ of_features.double()
        for name, grad in zip(weights, grads, strict=True):
            squares[name] += grad.double().square().flatten(2).mean(dim=2)
    return form, squares
