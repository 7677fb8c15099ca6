"""Show an export of a packed scene in other viewers and compare with Python's images; print one JSON line per setting.

    python benchmarks/bench_viewers.py scene.sundae                     # a .ply of all Gaussians
    python benchmarks/bench_viewers.py scene.sundae --kind spz --central
    python benchmarks/bench_viewers.py scene.sundae --kind glb --central --viewer three

The viewers are Spark, GaussianSplats3D, three.js, PlayCanvas and Babylon.js, each with the files that it reads, in a
Chromium that renders in software; ``make browser`` installs them. Six cameras, a black background, base colours. Each
setting of a viewer adds to the one before. ``--central`` keeps the Gaussians whose centres lie in all six images:
beside the image the viewers project and drop Gaussians differently. Lines belong in results/viewers.jsonl.
"""

from __future__ import annotations

import argparse
import base64
import json
import math
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from bench_page import SECONDS, SIDE, bundled, has_packages, psnr, scaled, truths
from numpy.typing import NDArray

from harness.chromium import Browser, find_chromium, wait_for
from sundae_ns.core.gaussians import FEATURES
from sundae_ns.io.formats import write_levels
from sundae_ns.io.pack.packed_scene import PackedScene, read_scene
from sundae_ns.scene.load_save import marks_of, save
from sundae_ns.scene.packing import arrays_of_cameras, scene_of

PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<script type="module" src="viewers.js"></script>"""
REACH = math.sqrt(2 * math.log(255))
"""Sigmas to where the alpha of an opaque Gaussian falls below 1/255."""
Options = dict[str, dict[str, Any]]
READS = {
    "spark": ("ply", "spz"),
    "gaussianSplats3D": ("ply",),  # it has versions 1 and 2 of .spz; Spark and we have 3
    "three": ("glb",),
    "playcanvas": ("ply", "sog", "glb", "lod"),
    "babylon": ("ply", "spz", "sog", "glb"),
}
"""Kinds of our files by viewer."""


def settings(kind: str, antialiased: bool) -> dict[str, dict[str, Options]]:
    """Settings of each viewer of a file by name, beginning with its own defaults; each contains those before."""
    blur = {"preBlurAmount": 0.0, "blurAmount": 0.3} if antialiased else {"preBlurAmount": 0.3, "blurAmount": 0.0}
    exact = {"sortRadial": False, "maxStdDev": REACH, "minAlpha": 1 / 255, "accumExtSplats": True}
    sorted_exactly = {"sphericalHarmonicsDegree": 2, "antialiased": antialiased, "integerBasedSort": False}
    ladders: dict[str, dict[str, Options]] = {
        "spark": {
            "default": {},
            "blur": {"renderer": blur},
            "full precision": {"renderer": exact, "scene": {"extSplats": True}},
        },
        "gaussianSplats3D": {"default": {}, "exact order": {"renderer": sorted_exactly}},
        "three": {"default": {}},
        "playcanvas": {
            "default": {},
            "blur": {"renderer": {"blur": 1.2}, "scene": {"antiAlias": antialiased}},
            "full precision": {"scene": {"dataFormat": "large"}},
        },
        "babylon": {"default": {}, "blur": {"scene": {"KernelSize": 1.2, "Compensation": antialiased}}},
    }
    ladders = {viewer: ladder for viewer, ladder in ladders.items() if kind in READS[viewer]}
    for ladder in ladders.values():
        total: Options = {"renderer": {}, "scene": {}}
        for name, step in ladder.items():
            total = {part: {**options, **step.get(part, {})} for part, options in total.items()}
            ladder[name] = total
    return ladders


def base_colors(scene: PackedScene) -> PackedScene:
    """The scene without its head, on a black background."""
    model = {**scene.meta["model"], "head": None, "trained_focal": None, "background_color": "black"}
    gaussians = {name: value for name, value in scene.gaussians.items() if name != FEATURES}
    return replace(scene, gaussians=gaussians, head={}, meta={**scene.meta, "model": model})


def central(scene: PackedScene) -> PackedScene:
    """The scene with the Gaussians whose centres lie in the images of all cameras."""
    keep = torch.ones(len(scene.gaussians["means"]), dtype=torch.bool)
    for camera in scene_of(scene).cameras:
        x, y, z = camera.K.float() @ (scene.gaussians["means"] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).T
        keep &= (z > 0) & (x > 0) & (x < z * camera.width) & (y > 0) & (y < z * camera.height)
    return replace(scene, gaussians={name: value[keep] for name, value in scene.gaussians.items()})


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        pass


def images_in(
    page: Browser, address: str, file: str, scene: PackedScene, viewer: str, options: Options
) -> list[NDArray[np.float64]]:
    """Images ``[H, W, 3]`` in [0, 1] of all cameras of a scene, of its export in a viewer of the page."""
    cameras = arrays_of_cameras(scene_of(scene).cameras)
    names, sizes = ("fx", "fy", "cx", "cy", "width", "height"), cameras["sizes"].tolist()
    shown = [
        {"pose": pose.flatten().tolist(), **dict(zip(names, [*lens, *size], strict=True))}
        for pose, lens, size in zip(cameras["poses"], cameras["intrinsics"].tolist(), sizes, strict=True)
    ]
    page.open(address)
    wait_for(lambda: page.evaluate("typeof show") == "function", "the viewers", SECONDS)
    words = ", ".join(json.dumps(word) for word in (viewer, file, shown, options))
    keep = "(found => { window.found = found; }, error => { window.found = String(error); })"
    # Several minutes in software: the page keeps the images until they are asked for.
    page.evaluate(f"window.found = null; show({words}).then{keep}; 0")
    wait_for(lambda: bool(page.evaluate("found !== null")), f"images of {viewer}", SECONDS)
    found = page.evaluate("found")
    if isinstance(found, str):
        raise RuntimeError(f"{viewer}: {found}")
    pixels = [np.frombuffer(base64.b64decode(image), np.uint8) for image in found]
    # WebGL begins with the lowest row.
    return [image.reshape(h, w, 4)[::-1, :, :3] / 255 for image, (w, h) in zip(pixels, sizes, strict=True)]


@contextmanager
def opened(scene: PackedScene, kind: str) -> Iterator[Callable[[str, Options], list[NDArray[np.float64]]]]:
    """The viewers with an export of a scene of a kind: images of all cameras by viewer and options."""
    chromium = find_chromium()
    if chromium is None or not has_packages():
        sys.exit("no Chromium or no viewers here: apt-get install chromium, then make browser")
    width, height = (int(side) for side in arrays_of_cameras(scene_of(scene).cameras)["sizes"][0])
    with TemporaryDirectory() as folder:
        site = Path(folder)
        (site / "index.html").write_text(PAGE)
        bundled("viewers.ts", site / "viewers.js", "--minify")
        file = "a/lod-meta.json" if kind == "lod" else f"a.{kind}"
        if kind == "lod":
            levels = scene_of(scene), scene_of(scene)[::10]
            write_levels(site / "a", [level.gaussians for level in levels], marks_of(levels[0]))
        else:
            save(scene_of(scene), site / file)
        with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=site)) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            try:
                with Browser(chromium, width, height) as page:
                    yield partial(images_in, page, f"http://127.0.0.1:{server.server_port}/", file, scene)
            finally:
                server.shutdown()


def rows(
    scene: Path, *, kind: str = "ply", side: int = SIDE, center: bool = False, only: str | None = None
) -> Iterator[dict[str, Any]]:
    """A line for each setting of each viewer, or of one, with the PSNR of six images against Python's."""
    shown = base_colors(scaled(read_scene(scene), side))
    if center:
        shown = central(shown)
    images = [truth["base_rgb"] for truth in truths(shown)]
    height, width, _ = images[0].shape
    about = {"scene": scene.name, "file": kind, "primitives": len(shown.gaussians["means"]), "central": center}
    with opened(shown, kind) as images_of:
        for viewer, ladder in settings(kind, shown.meta["model"]["rasterize_mode"] == "antialiased").items():
            if only not in (None, viewer):
                continue
            for name, options in ladder.items():
                found = images_of(viewer, options)
                each = [psnr(image, truth) for image, truth in zip(found, images, strict=True)]
                row = {**about, "size": f"{width}x{height}", "viewer": viewer, "setting": name, "psnr": each}
                yield {**row, "psnr_of_all": psnr(np.stack(found), np.stack(images))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="written by sundae pack")
    parser.add_argument("--kind", choices=("ply", "spz", "sog", "glb", "lod"), default="ply", help="of the export")
    parser.add_argument("--side", type=int, default=SIDE, help="longest side of the images, pixels")
    parser.add_argument("--viewer", choices=READS, help="one viewer instead of all")
    parser.add_argument("--central", action="store_true", help="only Gaussians whose centres lie in all images")
    options = parser.parse_args()
    for row in rows(options.scene, kind=options.kind, side=options.side, center=options.central, only=options.viewer):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
