"""Packed scenes of every kind that the format knows, with random fields and heads whose correction is visible."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from documents import put
from fields import random_field
from torch import Tensor

from sundae_ns.core.gaussians import Gaussians
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.io.pack import container
from sundae_ns.io.pack.codecs import Sensitivity
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, fit_scene, write_fitted
from sundae_ns.scene.load_save import load
from sundae_ns.scene.packing import contents_of
from sundae_ns.scene.scene import Background, Scene, from_points, initial_features

WIDTH, HEIGHT = 50, 37
FOCAL = 45.0


@dataclass(frozen=True)
class Kind:
    """What a scene differs in."""

    points: int = 400
    side: float = 1.0  # Of the cube, world units; another one is not in nerfstudio's frame
    degree: int = 3
    antialiased: bool = False
    background: Background = "random"
    head: HeadConfig | None = None
    focal: float | None = FOCAL  # Focal length that the head was trained at; None if unknown
    config: PackConfig | None = None
    measured: bool = False  # Whether steps follow a sensitivity, a random one here


def _head(mode: str, fold: int, features: int, size: str = "tiny") -> HeadConfig:
    return HeadConfig(mode=mode, pixel_unshuffle=fold, num_features=features, size=size)  # type: ignore[arg-type]


KINDS = {
    "no head, degree 3": Kind(),
    "logits": Kind(degree=0, background="white"),
    "degree 4, antialiased": Kind(degree=4, antialiased=True, background="black"),
    "residual": Kind(degree=2, head=_head("residual", 1, 5)),
    "residual, folded": Kind(degree=1, head=_head("residual", 2, 13, "compact"), focal=None),
    "features": Kind(degree=1, head=_head("features", 2, 8), background="white"),
    "measured": Kind(degree=2, head=_head("residual", 2, 5), measured=True),
    "trained at a larger scale": Kind(degree=1, head=_head("residual", 2, 4), focal=1.7 * FOCAL),
    "trained at a smaller scale": Kind(degree=1, head=_head("residual", 1, 4), focal=0.6 * FOCAL),
    # More than one workgroup sorts, and the lists of tiles outgrow their first buffers.
    "many Gaussians": Kind(points=20_000, degree=0, head=_head("residual", 1, 1)),
    "of millimetres": Kind(degree=1, side=1e-3),
    "other precisions": Kind(
        head=_head("residual", 1, 6),
        # Steps in the order of STEPS.
        config=PackConfig(16, 64, 0.001, 0.0001, 0.0001, 0.001, 0.0001, 1.0, 0.008),
    ),
}


def write_kind(path: Path, kind: Kind) -> Path:
    """Write a packed scene of a kind, with two cameras."""
    torch.manual_seed(0)
    n = kind.points
    points = kind.side * (torch.rand(n, 3) - 0.5)
    features = kind.head.num_features if kind.head else 3
    gaussians = from_points(points, torch.rand(n, 3), sh_degree=kind.degree)
    gaussians["features"] = initial_features(gaussians["features_dc"], features)
    gaussians["features_rest"] = 0.2 * torch.randn(n, (kind.degree + 1) ** 2 - 1, 3)
    gaussians["features"] = torch.randn(n, features)
    gaussians["quats"] = torch.randn(n, 4)
    # From specks below a pixel to a fifth of the image.
    gaussians["scales"] += 1.5 * torch.randn(n, 3) + (1.5 if n > 1000 else -0.5)
    gaussians["opacities"] = 3 * torch.randn(n, 1) + 1
    head = None
    if kind.head is None:
        gaussians.pop("features")
    else:
        head = CompensationHead(kind.head)
        if kind.head.mode == "residual":
            # The last layer starts at zero.
            head.net.out.weight.data = 0.3 * torch.randn_like(head.net.out.weight)
    focal = (kind.focal, kind.focal) if kind.head and kind.focal else None
    encoded = Gaussians(gaussians, "harmonics" if kind.degree else "logits")
    scene = Scene(encoded, head, kind.background, kind.antialiased, focal, in_model_frame=kind.side == 1)
    packed = contents_of(scene)
    sensitivity = _sensitivity(gaussians, packed.head) if kind.measured else Sensitivity({}, {})
    write_fitted(path, *fit_scene(replace(packed, cameras=_cameras(kind.side), sensitivity=sensitivity), kind.config))
    return path


def write_bomb(path: Path, count: int = 20_000) -> Path:
    """Write a small file of faint Gaussians, each of which covers the whole image of the first of two cameras.

    The second camera looks the other way.
    """
    one = torch.ones(count, 1)
    gaussians = {
        "means": 0.01 * torch.rand(count, 3),
        "quats": one * torch.tensor([1.0, 0.0, 0.0, 0.0]),
        "scales": one * torch.full((3,), 3.0),
        "opacities": -4.5 * one,
        "features_dc": one * torch.zeros(3),
        "features_rest": torch.zeros(count, 3, 3),
    }
    poses = torch.stack([torch.eye(4)[:3], torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))[:3]])
    poses[:, 2, 3] = 2.0
    lens = torch.tensor([300.0, 300.0, 160.0, 120.0]).double().repeat(2, 1)
    cameras = {"poses": poses, "intrinsics": lens, "sizes": torch.tensor([[320, 240]]).repeat(2, 1)}
    model = {"sh_degree": 1, "rasterize_mode": "classic", "background_color": "white", "head": None}
    write_fitted(path, *fit_scene(PackedScene(gaussians, {}, cameras, {"model": model})))
    return path


def _sensitivity(gaussians: Mapping[str, Tensor], head: Mapping[str, Tensor]) -> Sensitivity:
    """Random positive definite forms, and weights that differ by some powers of ten."""
    roots = {name: torch.randn(2 * [gaussians[name][0].numel()]).double() for name in ("features_rest", "features")}
    weights = {name: value for name, value in head.items() if value.ndim > 1}
    return Sensitivity(
        {name: root @ root.T + 0.1 * torch.eye(len(root)) for name, root in roots.items()},
        {name: torch.randn(value.shape[:2]).mul(3).exp().double() for name, value in weights.items()},
    )


def _cameras(side: float) -> dict[str, Tensor]:
    turn = torch.linalg.qr(torch.eye(3) + 0.1 * torch.randn(3, 3)).Q
    turn = turn * turn.diagonal().sign()
    poses = torch.stack([torch.cat([turn, 1.4 * turn[:, 2:]], dim=1), torch.eye(4)[:3]])
    # The second camera is close: Gaussians are behind it, beside it and across the whole image.
    poses[1, :, 3] = torch.tensor([0.1, 0.0, 0.55])
    poses[:, :, 3] *= side
    lens = torch.tensor([FOCAL, FOCAL + 1, 24.0, 19.5]).double()
    return {"poses": poses, "intrinsics": lens.repeat(2, 1), "sizes": torch.tensor([[WIDTH, HEIGHT]]).repeat(2, 1)}


def packed_file(path: Path) -> tuple[Scene, bytes]:
    """A packed scene, and the bytes of its file."""
    return load(path), path.read_bytes()


def header_and_body(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Header and sections of a packed scene."""
    (length,) = struct.unpack("<I", content[12:16])
    return json.loads(content[48 : 48 + length]), content[48 + length :]


def sealed(meta: dict[str, Any] | bytes, body: bytes) -> bytes:
    """A packed scene with this header and body, and a valid checksum of the header."""
    text = meta if isinstance(meta, bytes) else json.dumps(meta).encode()
    return b"\x89SUNDAE\n" + struct.pack("<II", 3, len(text)) + hashlib.sha256(text).digest() + text + body


def resealed(meta: dict[str, Any], body: bytes) -> bytes:
    """The file with valid checksums of header and sections."""
    offset = 0
    for section in meta["sections"]:
        end = offset + sum(section["parts"])
        section["sha256"], offset = hashlib.sha256(body[offset:end]).hexdigest(), end
    return sealed(meta, body)


def full_scene(n: int = 600, degree: int = 2, features: int = 5, meta: dict[str, Any] | None = None) -> PackedScene:
    """A random field with a head of one layer and two cameras."""
    generator = torch.Generator().manual_seed(1)
    head = {"a.weight": torch.randn(4, 3, 3, 3, generator=generator), "a.bias": torch.randn(4, generator=generator)}
    cameras = {
        "poses": torch.eye(4)[:3].repeat(2, 1, 1),
        "intrinsics": torch.tensor([[50.25, 51.5, 31.5, 24.0]]).double().repeat(2, 1),
        "sizes": torch.tensor([[64, 48], [32, 24]]),
    }
    return PackedScene(random_field(n, degree, features), head, cameras, meta or {})


def restate(path: Path, changes: Mapping[str, Any]) -> None:
    """Change values of the header by their paths; checksums stay valid."""
    meta, body = header_and_body(path.read_bytes())
    put(meta, changes)
    path.write_bytes(sealed(meta, body))


def resection(path: Path, name: str, array: Any) -> None:
    """Replace or add a section; checksums stay valid."""
    header = container.read_header(path)
    meta = {key: value for key, value in header.meta.items() if key != "sections"}
    path.write_bytes(container.encode(meta, {**container.read_sections(path, header), name: array})[0])


def scene(n: int = 200, degree: int = 2, **values: Any) -> Scene:
    """A random field without a head, of Gaussians that cover pixels."""
    gaussians = random_field(n, degree=degree, features=0)
    gaussians["scales"] += 2
    return Scene(Gaussians(gaussians), **values)
