"""Compare six cameras of a packed scene in the web page with Python's images, and time the page; print one JSON line.

    python benchmarks/bench_page.py scene.sundae               # images of at most 320 pixels
    python benchmarks/bench_page.py scene.sundae --side 800 --half

It needs a Chromium, which renders in software here. The cameras and the sizes that the head was trained at are scaled
together, so both renderers run the head at the size of the image. The page's images are bytes: rounding alone gives
58.9 dB. With ``--half`` the page's renderer also runs under Node in half precision, on an adapter that has it (``make
browser`` installs what it needs). Lines belong in results/page.jsonl; ``make browser`` asserts such errors.
"""

from __future__ import annotations

import argparse
import base64
import copy
import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import sundae_ns as sn
from harness.chromium import WEBGPU, Browser, find_chromium, wait_for
from sundae_ns.io.pack import container
from sundae_ns.io.pack.packed_scene import CAMERAS as STORED
from sundae_ns.io.pack.packed_scene import PackedScene, read_scene
from sundae_ns.scene.packing import arrays_of_cameras, scene_of
from sundae_ns.scene.page import write_page

SECONDS = 400.0
"""Longest wait for the page: shaders compile in software."""
CAMERAS = 6
SIDE = 320
"""Longest side of an image, pixels."""
WEB = Path(__file__).parents[1] / "web"


def scaled(scene: PackedScene, side: int) -> PackedScene:
    """The scene with six of its cameras, no larger than ``side``, as if the head had been trained at that size."""
    cameras = arrays_of_cameras(scene_of(scene).cameras)
    picks = torch.linspace(0, len(cameras["poses"]) - 1, CAMERAS).round().long().unique()
    sizes = cameras["sizes"][picks].double()
    targets = (sizes * min(side / int(sizes.max()), 1.0)).round().clamp_min(1)
    shares = targets / sizes
    intrinsics = cameras["intrinsics"][picks] * shares.repeat(1, 2)
    sized = {"poses": cameras["poses"][picks], "intrinsics": intrinsics, "sizes": targets.to(cameras["sizes"])}
    meta = copy.deepcopy(scene.meta)
    focal = meta["model"].get("trained_focal")
    if focal is not None:
        meta["model"]["trained_focal"] = [value * float(shares.mean()) for value in focal]
    return replace(scene, cameras=sized, meta=meta)


def write_changed(out: Path, scene: Path, small: PackedScene) -> PackedScene:
    """Write a file with the cameras of ``small``; levels and steps are copied: the page decodes those of the file."""
    header = container.read_header(scene)
    meta = {**header.meta, **small.meta}
    del meta["sections"]
    assert small.cameras is not None
    dtypes = {name: section["dtype"] for name, section in STORED.items()}
    cameras = {f"cameras/{name}": small.cameras[name].numpy().astype(dtype) for name, dtype in dtypes.items()}
    unpacked = 4 * sum(value.numel() for value in (*small.gaussians.values(), *small.head.values()))
    sections = {**container.read_sections(scene, header), **cameras}
    out.write_bytes(container.encode(meta, sections, unpacked=unpacked)[0])
    return read_scene(out)


def truths(scene: PackedScene) -> list[dict[str, NDArray[np.float32]]]:
    """``rgb`` and ``base_rgb`` of each camera by Python."""
    whole = scene_of(scene)
    shown = {"rgb": whole, "base_rgb": replace(whole, head=None)}
    return [{name: sn.render(each, view).rgb.numpy() for name, each in shown.items()} for view in whole.cameras]


def image(page: Any, camera: int, head: bool, scale: float = 1.0) -> NDArray[np.float64]:
    """An image of the page ``[H, W, 3]`` in [0, 1]."""
    found = page.evaluate(f"sundae.image({camera}, {str(head).lower()}, {scale})")
    pixels = np.frombuffer(base64.b64decode(found["pixels"]), np.uint8)
    return pixels.reshape(found["height"], found["width"], 4)[..., :3] / 255


def psnr(found: NDArray[Any], truth: NDArray[Any]) -> float:
    assert found.shape == truth.shape
    return round(float(-10 * np.log10(np.mean((found - truth) ** 2) + 1e-12)), 2)


def compared(scene: Path, side: int = SIDE, *, half: bool = False) -> dict[str, Any]:
    """A packed scene in the page: sizes, times, and the PSNR of six images against Python's of the same file."""
    chromium = find_chromium()
    if chromium is None:
        sys.exit("no Chromium here: apt-get install chromium")
    with TemporaryDirectory() as folder:
        packed, html = Path(folder) / "a.sundae", Path(folder) / "a.html"
        small = write_changed(packed, scene, scaled(read_scene(scene), side))
        write_page(html, (scene.stem, scene_of(small), packed.read_bytes()))
        images = truths(small)
        width, height = (int(length) for length in arrays_of_cameras(scene_of(small).cameras)["sizes"][0])
        row: dict[str, Any] = {"scene": scene.name, "bytes": scene.stat().st_size, "size": f"{width}x{height}"}
        row |= {"primitives": len(small.gaussians["means"]), "head": bool(small.head)}
        with Browser(chromium, width, height, WEBGPU) as page:
            began = time.perf_counter()
            page.open(html.as_uri())
            loaded = "window.sundae && window.sundae.state !== 'loading'"
            wait_for(lambda: bool(page.evaluate(loaded)), "the page", SECONDS)
            row["first_image_s"] = round(time.perf_counter() - began, 1)
            # The first image has base colours; the head follows once the camera rests.
            wait_for(lambda: bool(page.evaluate("sundae.still || sundae.state === 'failed'")), "the head", SECONDS)
            times = page.evaluate("sundae.times") or {}
            row |= {f"ms_{name}": round(times.get(name, 0)) for name in ("splat", "head")}
            row["psnr_base"], row["psnr_head"] = [], []
            for camera, truth in enumerate(images):
                row["psnr_base"].append(psnr(image(page, camera, False), truth["base_rgb"]))
                if small.head:
                    row["psnr_head"].append(psnr(image(page, camera, True), truth["rgb"]))
        made = half_images(packed) if half and small.head else None
        if made is not None:
            row["adapter_half"] = made[0]
            row["psnr_half"] = [psnr(found, truth["rgb"]) for found, truth in zip(made[1], images, strict=True)]
    return row


def bundled(source: str, out: Path, *options: str) -> Path:
    """A program of ``web/tests`` with all that it imports, as one module."""
    esbuild = WEB / "node_modules" / ".bin" / "esbuild"
    words = [f"tests/{source}", "--bundle", "--format=esm", "--loader:.wgsl=text", "--log-level=error", *options]
    subprocess.run([esbuild, *words, f"--outfile={out.resolve()}"], cwd=WEB, check=True)
    return out


def has_packages() -> bool:
    """Whether the packages of ``web/tests`` are installed, which ``make browser`` does where it finds npm."""
    folders = (WEB / "node_modules", WEB / "tests" / "node_modules")
    return shutil.which("node") is not None and all(folder.is_dir() for folder in folders)


def half_images(packed: Path) -> tuple[str, list[NDArray[np.float64]]] | None:
    """Images of all cameras by the page's renderer in half precision, head included; None without such an adapter."""
    if not has_packages():
        return None
    # Beside the packages, where Node looks for Dawn.
    with TemporaryDirectory(dir=WEB / "tests" / "node_modules") as folder:
        program = bundled("render.ts", Path(folder) / "render.mjs", "--platform=node", "--external:webgpu")
        copy = Path(folder) / "a.sundae"
        copy.write_bytes(packed.read_bytes())
        found = subprocess.run(["node", program, copy], check=True, capture_output=True, text=True)
        adapter = json.loads(found.stdout.splitlines()[-1])
        if adapter is None:
            return None
        sizes = arrays_of_cameras(scene_of(read_scene(packed)).cameras)["sizes"].tolist()
        files = [np.fromfile(f"{copy}.{i}", np.uint8) for i in range(len(sizes))]
        pixels = [file.reshape(height, width, 4) for file, (width, height) in zip(files, sizes, strict=True)]
        return adapter, [each[..., :3] / 255 for each in pixels]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="written by sundae pack")
    parser.add_argument("--side", type=int, default=SIDE, help="longest side of the images, pixels")
    parser.add_argument("--half", action="store_true", help="render in half precision too")
    options = parser.parse_args()
    print(json.dumps(compared(options.scene, options.side, half=options.half)))


if __name__ == "__main__":
    main()
