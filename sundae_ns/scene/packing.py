"""Conversion between scenes and the contents of packed files, whose values are checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from sundae_ns.core.camera import Camera
from sundae_ns.core.errors import ConfigError, PackError
from sundae_ns.core.gaussians import FEATURES, Gaussians, sanitise
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.io.coordinates import Direction
from sundae_ns.io.pack.codecs import Sensitivity
from sundae_ns.io.pack.container import FORMAT, fault
from sundae_ns.io.pack.packed_scene import PackedScene
from sundae_ns.rasterize.reference import MIN_ALPHA, harmonic_basis
from sundae_ns.scene.cameras import is_frame, spread
from sundae_ns.scene.render import GaussianSource, render_view
from sundae_ns.scene.scene import Scene, unit
from sundae_ns.scene.virtual_cameras import at_most

_MODEL: dict[str, Any] = FORMAT["model"]
_PROPERTIES: dict[str, Any] = FORMAT["header"]["properties"]


def scene_of(packed: PackedScene) -> Scene:
    """The scene of a packed file's contents, on the CPU; ``PackError`` for an impossible model, or another head."""
    stated: dict[str, Any] = packed.meta.get("model")  # type: ignore[assignment]
    if (wrong := fault(stated, _MODEL, "model")) is not None:
        raise refusal(f"no valid {wrong}")
    degree, focal = int(stated["sh_degree"]), stated.get("trained_focal")
    if packed.gaussians["features_rest"].shape[1] > (degree + 1) ** 2 - 1:
        raise refusal("a lower SH degree than it has")
    meta = {name: packed.meta[name] for name in ("source", "frame", "capture") if packed.meta.get(name) is not None}
    if not is_frame(meta.get("frame")):
        meta.pop("frame", None)
    up, start = start_of(packed.meta)
    cameras: tuple[Camera, ...] = ()
    if (arrays := packed.cameras) is not None:
        rows = zip(arrays["poses"], arrays["intrinsics"].tolist(), arrays["sizes"].tolist(), strict=True)
        cameras = tuple(Camera.from_pose(pose, intrinsics, *size) for pose, intrinsics, size in rows)
    return Scene(
        Gaussians(dict(packed.gaussians), "logits" if degree == 0 else "harmonics"),
        _head_of(packed, stated.get("head")),
        background_color=stated["background_color"],
        antialiased=stated["rasterize_mode"] == "antialiased",
        trained_focal=None if focal is None else (float(focal[0]), float(focal[1])),
        cameras=cameras,
        up=up,
        start=start,
        in_model_frame=meta.get("source", {}).get("model_frame") is not False,
        meta=meta,
    )


def contents_of(scene: Scene) -> PackedScene:
    """The contents of a packed file for the Gaussians of a scene that are drawn, with what cameras see of errors."""
    finite = sanitise(scene.gaussians).gaussians
    drawn = finite["opacities"][:, 0].sigmoid() >= MIN_ALPHA  # training leaves others, some narrower than any cell
    scene = replace(scene, gaussians=finite.rows(drawn) if bool(drawn.any()) else finite).to("cpu")
    head = {} if scene.head is None else dict(scene.head.state_dict())
    gaussians = {name: value.detach() for name, value in scene.gaussians.items() if name != FEATURES or head}
    required = _MODEL["properties"]["head"]["required"]
    options = None if scene.head is None else {name: getattr(scene.head.config, name) for name in required}
    degree = 0 if scene.gaussians.encoding == "logits" else max(scene.gaussians.sh_degree, 1)  # 0 stands for logits
    model = {
        "sh_degree": degree,
        "rasterize_mode": "antialiased" if scene.antialiased else "classic",
        "background_color": scene.background_color,
        "head": options,
        "trained_focal": list(scene.trained_focal) if head and scene.trained_focal else None,
    }
    source = {**scene.meta.get("source", {}), **({} if scene.in_model_frame else {"model_frame": False})}
    meta = {**scene.meta, "source": source, "model": model, **stated_start(scene)}
    if not scene.cameras:
        return PackedScene(gaussians, head, None, meta)
    return PackedScene(gaussians, head, arrays_of_cameras(scene.cameras), meta, sensitivity_of(scene, scene.cameras))


def stated_start(scene: Scene) -> dict[str, Any]:
    """Entries ``up`` and ``start`` of a packed file's header; ``ConfigError`` for values that readers would refuse."""
    stated: dict[str, Any] = {} if scene.up is None else {"up": list(scene.up)}
    if (camera := scene.start) is not None:
        stated["start"] = {
            "pose": camera.pose.double().tolist(),
            "intrinsics": camera.K.double()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
            "size": [camera.width, camera.height],
        }
    if "start" in stated and fault(stated["start"], _PROPERTIES["start"]) is not None:
        raise ConfigError("the start view of the scene has values that readers refuse; give another one")
    return stated


def start_of(stated: Mapping[str, Any]) -> tuple[Direction | None, Camera | None]:
    """Up axis and start view of JSON values; None for one that is missing, or that the schema refuses."""
    names = {"up", "start"} & stated.keys()
    valid = {name: stated[name] for name in names if fault(stated[name], _PROPERTIES[name]) is None}
    up, start = valid.get("up"), valid.get("start")
    return up and unit(up), start and Camera.from_pose(start["pose"], start["intrinsics"], *start["size"])


def arrays_of_cameras(cameras: Sequence[Camera]) -> dict[str, Tensor]:
    """Cameras as a packed file holds them: poses ``[V, 3, 4]``, intrinsics ``[V, 4]`` and sizes ``[V, 2]``."""
    return {
        "poses": torch.stack([camera.pose for camera in cameras]).cpu(),
        "intrinsics": torch.stack([camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in cameras]).double().cpu(),
        "sizes": torch.tensor([[camera.width, camera.height] for camera in cameras]),
    }


def _head_of(packed: PackedScene, stated: Mapping[str, Any] | None) -> CompensationHead | None:
    features = packed.gaussians[FEATURES].shape[1] if FEATURES in packed.gaussians else 0
    if stated is None and not packed.head and features == 0:
        return None
    if stated is None or features != stated["num_features"]:
        raise refusal("another number of features than it has")
    integers = {name: int(stated[name]) for name in ("pixel_unshuffle", "num_features")}
    if (head := CompensationHead.of_weights(HeadConfig(**{**stated, **integers}, start_at=0), packed.head)) is None:
        raise refusal("another head than it has")
    return head


def refusal(reason: str) -> PackError:
    """The error of a scene that states something impossible."""
    return PackError(f"the packed scene states {reason}; update this program, or pack it again")


def sensitivity_of(scene: Scene, cameras: Sequence[Camera]) -> Sensitivity:
    """Effect of quantisation errors on images, which decides where a pack spends its bits; the scene is on the CPU.

    With random signs r of the pixels, the mean square of the derivative of sum(r * image) is the sum of the squared
    derivatives (Hutchinson, 1990). Cameras and signs are fixed, so that a run packs alike each time.
    """
    rows = {}
    degree = scene.gaussians.sh_degree if scene.gaussians.encoding == "harmonics" else 0
    if degree > 0:
        rows["features_rest"] = _of_harmonics(scene.gaussians["means"].detach(), cameras, degree).kron(torch.eye(3))
    head: dict[str, Tensor] = {}
    if scene.head is not None:
        rows[FEATURES], head = _of_head(scene, cameras)
    return Sensitivity(rows, head)


def _of_harmonics(means: Tensor, cameras: Sequence[Camera], degree: int) -> Tensor:
    """Sum of the products of basis functions of degrees 1 and up, over views and the Gaussians they see ``[K, K]``."""
    chosen = means[:: -(-len(means) // (1 << 14))]
    total = torch.zeros((degree + 1) ** 2 - 1, (degree + 1) ** 2 - 1, dtype=torch.float64)
    for camera in cameras:
        x, y, z = (chosen @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).T
        across, down = x / z * camera.K[0, 0] + camera.K[0, 2], y / z * camera.K[1, 1] + camera.K[1, 2]
        visible = chosen[(z > 0) & (across >= 0) & (across < camera.width) & (down >= 0) & (down < camera.height)]
        basis = harmonic_basis(degree, torch.nn.functional.normalize(visible - camera.center, dim=1))[:, 1:].double()
        total += basis.T @ basis
    # A little of the identity: a form without any view is singular.
    return total + 1e-6 * (1 + total.trace()) * torch.eye(len(total), dtype=torch.float64)


@torch.enable_grad()  # type: ignore[untyped-decorator]
def _of_head(scene: Scene, cameras: Sequence[Camera]) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean products of the derivatives by pairs of features ``[F, F]``, and mean squares of those by weights."""
    assert scene.head is not None
    features = scene.gaussians[FEATURES].detach().requires_grad_()
    source = GaussianSource(scene.gaussians.replaced({FEATURES: features}))
    settings = replace(scene.settings(), training=True)
    weights = {name: value.requires_grad_() for name, value in scene.head.named_parameters() if value.ndim > 1}
    form = torch.zeros(features.shape[1], features.shape[1], dtype=torch.float64)
    squares = {name: torch.zeros(value.shape[:2], dtype=torch.float64) for name, value in weights.items()}
    signs = torch.Generator().manual_seed(0)
    for i in spread(len(cameras), 8):
        image = render_view(source, at_most(cameras[i], 1 << 17), scene.background, settings, depth=False)[0]["rgb"]
        random = torch.randint(0, 2, image.shape, generator=signs) * 2.0 - 1
        of_features, *grads = torch.autograd.grad((image * random).sum(), [features, *weights.values()])
        form += of_features.double().T @ of_features.double()
        for name, grad in zip(weights, grads, strict=True):
            squares[name] += grad.double().square().flatten(2).mean(dim=2)
    return form, squares
