"""Facts of a scene and its file, and the share of it that cameras see."""

from __future__ import annotations

import re
import zipfile
from collections import Counter
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from sundae_ns.core.camera import Camera
from sundae_ns.core.files import write_image
from sundae_ns.core.gaussians import bytes_of
from sundae_ns.head.head import bytes_of_module
from sundae_ns.io.config_file import find_config
from sundae_ns.io.formats import METAS, kind_of, kind_of_gaussians
from sundae_ns.io.pack.container import read_header
from sundae_ns.io.splat import rank_files
from sundae_ns.scene.cameras import spread
from sundae_ns.scene.compose import box_of, floater_mask, for_cleaning, means_in_file
from sundae_ns.scene.page import opened_page
from sundae_ns.scene.prune_scene import at_most, weights_in
from sundae_ns.scene.scene import Scene, image_of, render
from sundae_ns.scene.virtual_cameras import by_device, virtual_cameras

HELD_OUT, SEEN_BY = 16, 64  # cameras that measure the loss of a change, and virtual ones that say what is seen
PIXELS = {"cpu": 1 << 18, "cuda": 1 << 20}  # most of their images, by the device
_PRODUCER = re.compile(rb'(?im)"generator"\s*:\s*"([^"]{1,200})"|^comment ([^\r\n]* (?:by|from) [^\r\n]{1,200})')


def held_out_cameras(scene: Scene, cameras: Sequence[Camera], count: int = HELD_OUT, *, seed: int = 0) -> list[Camera]:
    """At most ``count`` of the cameras, evenly spaced; without any, virtual ones that no prune of this seed uses."""
    if not cameras:
        return virtual_cameras(scene, count, seed=seed + 1)
    return [at_most(cameras[i], by_device(PIXELS, scene.device)) for i in spread(len(cameras), count)]


def write_preview(path: Path, before: Scene, after: Scene, cameras: Sequence[Camera]) -> None:
    """Write images of two scenes, side by side, as a PNG: of the held-out camera in which they differ most."""
    pairs = [[render(scene, view).rgb for scene in (before, after)] for view in held_out_cameras(before, cameras)]
    most = max(pairs, key=lambda pair: float((pair[0] - pair[1]).square().mean()))
    write_image(path, image_of(torch.cat(most, dim=1)))


def bytes_at(path: Path) -> int | None:
    """Bytes of the files or the folder of a scene; None for a run, which holds more than that."""
    if (kind := kind_of_gaussians(path)) is None and kind_of(path) is None and find_config(path) is not None:
        return None
    files = rank_files(path) if kind == "gsplat" else {path, *(path.parent if path.name in METAS else path).rglob("*")}
    return sum(file.stat().st_size for file in files if file.is_file())


@torch.no_grad()
def describe(
    scene: Scene, path: Path, cameras: Sequence[Camera] = (), *, console: Console | None = None
) -> dict[str, Any]:
    """Facts of a scene that was loaded from a path, as plain values for JSON; coordinates are those of its file.

    ``invisible`` is the share of the Gaussians that no camera sees, ``floaters`` how many a cleaning would remove, and
    ``crop`` a box, lowest corner first, of 99% of what they see. Cameras are by default the stored, else virtual ones.
    """
    cameras = cameras or scene.cameras
    views = for_cleaning(cameras) or virtual_cameras(scene, SEEN_BY)
    weights = weights_in(scene, views, console=console)
    means = means_in_file(scene)
    with path.open("rb") if path.is_file() else BytesIO() as file:
        stated = _PRODUCER.search(file.read(-1 if kind_of(path) == "sog" else 1 << 16))  # its meta.json is anywhere
    return {
        "bytes": bytes_at(path) or bytes_of(scene.gaussians) + bytes_of_module(scene.head),
        "gaussians": scene.num_gaussians,
        "sh_degree": scene.gaussians.sh_degree,
        "head": None if scene.head is None else scene.head.config.size,
        "low": means.amin(dim=0).tolist(),
        "high": means.amax(dim=0).tolist(),
        "up": None if scene.up is None else list(scene.up),
        "antialiased": scene.antialiased,
        "nerfstudio_frame": scene.in_model_frame,
        "producer": stated and (stated[1] or stated[2]).decode("utf-8", "replace").strip(),
        "stored_cameras": len(scene.cameras),
        "bytes_by_attribute": bytes_by_attribute(scene, path),
        "seen_by": f"{len(views)} {'cameras' if cameras else 'virtual cameras'}",
        "invisible": float((weights <= 0).float().mean()),
        "floaters": int((floater_mask(scene, ()) | ((weights <= 0) & bool(cameras))).sum()),
        "crop": box_of(means, weights),
    }


def bytes_by_attribute(scene: Scene, path: Path) -> dict[str, int]:
    """Bytes of each part of a packed scene, a page or a .sog in its file; of others, of the Gaussians in fp32."""
    sizes = Counter[str]()
    if path.suffix.lower() == ".html":
        with opened_page(path) as packed:
            sizes |= bytes_by_attribute(scene, packed)
        sizes["page"] = path.stat().st_size - sizes.total()
    elif kind_of(path) == "packed":
        for name, section in read_header(path).sections.items():
            sizes[name.split("/")[0]] += sum(section.parts)
    elif kind_of(path) == "sog":
        with zipfile.ZipFile(path) as bundle:
            for entry in bundle.infolist():
                sizes[re.split(r"[_.]", Path(entry.filename).name)[0]] += entry.compress_size
    else:
        sizes |= {f"{name}, fp32": 4 * value.numel() for name, value in scene.gaussians.items()}
        sizes["head"] = bytes_of_module(scene.head)
    return {name: size for name, size in sizes.items() if size}
