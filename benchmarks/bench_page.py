"""Compare six cameras of a packed scene in the web page with Python's images, and time the page; print one JSON line.

    python benchmarks/bench_page.py scene.sundae               # cameras at 0.4 of their size
    python benchmarks/bench_page.py scene.sundae --scale 1

It needs a Chromium, which renders in software here. The cameras and the sizes that the head was trained at are scaled
together, so both renderers run the head at the size of the image. The page's images are bytes: rounding alone gives 58.9 dB.
Lines belong in results/page.jsonl.
"""

from __future__ import annotations

import argparse
import base64
import copy
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from browser import WEBGPU, Browser, find_chromium, wait_for
from nerfstudio.cameras.cameras import Cameras
from numpy.typing import NDArray

from sundae_ns.scenes.packed import cameras_of, model_of
from sundae_ns.scenes.page import write_page
from sundae_ns.storage.packing import Scene, read_scene, write_scene

SECONDS = 400.0
"""Longest wait for the page: shaders compile in software."""
CAMERAS = 6


def scaled(scene: Scene, scale: float) -> Scene:
    """The scene with six of its cameras at another size, as if the head had been trained at that size."""
    cameras = cameras_of(scene)
    picks = torch.linspace(0, len(cameras["poses"]) - 1, CAMERAS).round().long().unique()
    cameras = {name: value[picks].clone() for name, value in cameras.items()}
    sizes = (cameras["sizes"] * scale).round().clamp_min(1)
    shares = sizes / cameras["sizes"]
    cameras["intrinsics"] = cameras["intrinsics"] * shares.repeat(1, 2).to(cameras["intrinsics"])
    cameras["sizes"] = sizes.to(cameras["sizes"].dtype)
    meta = copy.deepcopy(scene.meta)
    focal = meta["model"].get("trained_focal")
    if focal is not None:
        meta["model"]["trained_focal"] = [value * float(shares.mean()) for value in focal]
    return replace(scene, cameras=cameras, meta=meta)


def truths(scene: Scene) -> list[dict[str, NDArray[np.float32]]]:
    """``rgb`` and ``base_rgb`` of each camera, by Python."""
    model, cameras = model_of(scene), cameras_of(scene)
    images = []
    for pose, lens, size in zip(*(cameras[name] for name in ("poses", "intrinsics", "sizes")), strict=True):
        fx, fy, cx, cy = lens.float().reshape(4, 1, 1)
        width, height = size.reshape(2, 1, 1)
        with torch.no_grad():
            outputs = model.get_outputs(Cameras(pose[None], fx, fy, cx, cy, width, height))
        images.append({name: outputs[name].numpy() for name in ("rgb", "base_rgb")})
    return images


def image(page: Any, camera: int, head: bool, scale: float = 1.0) -> NDArray[np.float64]:
    """An image of the page ``[H, W, 3]`` in [0, 1]."""
    found = page.evaluate(f"sundae.image({camera}, {str(head).lower()}, {scale})")
    pixels = np.frombuffer(base64.b64decode(found["pixels"]), np.uint8)
    return pixels.reshape(found["height"], found["width"], 4)[..., :3] / 255


def psnr(found: NDArray[Any], truth: NDArray[Any]) -> float:
    assert found.shape == truth.shape
    return float(-10 * np.log10(np.mean((found - truth) ** 2) + 1e-12))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="written by sundae pack")
    parser.add_argument("--scale", type=float, default=0.4, help="of the cameras")
    options = parser.parse_args()
    chromium = find_chromium()
    if chromium is None:
        sys.exit("no Chromium here: apt-get install chromium")
    with TemporaryDirectory() as folder:
        packed, html = Path(folder) / "a.sundae", Path(folder) / "a.html"
        write_scene(packed, scaled(read_scene(options.scene), options.scale))
        write_page(packed, html, title=options.scene.stem)
        scene = read_scene(packed)
        images = truths(scene)
        width, height = (int(side) for side in cameras_of(scene)["sizes"][0])
        row = {"scene": options.scene.name, "bytes": options.scene.stat().st_size, "size": f"{width}x{height}"}
        row |= {"primitives": len(scene.field["means"]), "head": bool(scene.head)}
        with Browser(chromium, width, height, WEBGPU) as page:
            began = time.perf_counter()
            page.open(html.as_uri())
            loaded = "window.sundae && window.sundae.state !== 'loading'"
            wait_for(lambda: bool(page.evaluate(loaded)), "the page", SECONDS)
            row["first_image_s"] = round(time.perf_counter() - began, 1)
            times = page.evaluate("sundae.times") or {}
            row |= {f"ms_{name}": round(times.get(name, 0)) for name in ("splat", "head")}
            row["psnr_base"], row["psnr_head"] = [], []
            for camera, truth in enumerate(images):
                row["psnr_base"].append(round(psnr(image(page, camera, False), truth["base_rgb"]), 2))
                if scene.head:
                    row["psnr_head"].append(round(psnr(image(page, camera, True), truth["rgb"]), 2))
    print(json.dumps(row))


if __name__ == "__main__":
    main()
