"""Compare six cameras of a packed scene in the web page with Python's images, and time the page; print one JSON line.

    python benchmarks/bench_page.py scene.sundae               # images of at most 320 pixels
    python benchmarks/bench_page.py scene.sundae --side 800 --half
    python benchmarks/bench_page.py scene.sundae --dawn 800x533 1920x1080     # time the passes, without a browser

It needs a Chromium, which renders in software here. The cameras and the sizes that the head was trained at are scaled
together, so both renderers run the head at the size of the image. The page's images are bytes: rounding alone gives
58.9 dB. With ``--half`` the page's renderer also runs under Node in half precision, on an adapter that has it (``make
browser`` installs what it needs). Lines belong in results/page.jsonl, and ``make browser`` checks them.

``--dawn`` runs the page's renderer under Node, on the GPU that Dawn finds by Vulkan. Each size has a line with the head
off and one with it on: milliseconds, and PSNR of the first two cameras. Images are cropped to the size. ``--folder``
writes all that this needs to a folder instead, for ``node FOLDER/timing.mjs FOLDER`` on another machine.
"""

from __future__ import annotations

import argparse
import base64
import copy
import json
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from numpy.typing import NDArray
from torch import Tensor

from harness.chromium import WEBGPU, Browser, find_chromium, wait_for
from sundae_ns.api.packing import arrays_of_views, scene_of
from sundae_ns.api.page import write_page
from sundae_ns.scenes.models import model_of
from sundae_ns.storage.pack import PackedScene, container, read_scene
from sundae_ns.storage.pack.scene import CAMERAS as STORED

SECONDS = 400.0
"""Longest wait for the page: shaders compile in software."""
CAMERAS = 6
SIDE = 320
"""Longest side of an image, pixels."""
WEB = Path(__file__).parents[1] / "web"
FRAMES = 60
COMPARED = 2
"""Cameras whose images are compared where passes are timed."""
ROWS = 135
"""Most rows of such an image that are compared: images of full size are many megabytes."""
PROCESSORS = {"x86_64": "x64", "aarch64": "arm64"}
"""Node's names."""
SECONDS_OF_FRAMES = 20.0
"""Longest time for one kind of frames: a software adapter takes seconds for each."""


def sized(scene: PackedScene, intrinsics: Tensor, sizes: Tensor, picks: Tensor, share: float) -> PackedScene:
    """The scene with some of its cameras, with other lenses, and its head at ``share`` of the scale of its training."""
    cameras = {name: value[picks].clone() for name, value in arrays_of_views(scene_of(scene).views).items()}
    cameras["intrinsics"] = intrinsics.to(cameras["intrinsics"])
    cameras["sizes"] = sizes.to(cameras["sizes"])
    meta = copy.deepcopy(scene.meta)
    focal = meta["model"].get("trained_focal")
    if focal is not None:
        meta["model"]["trained_focal"] = [value * share for value in focal]
    return replace(scene, cameras=cameras, meta=meta)


def picked(scene: PackedScene) -> tuple[Tensor, Tensor, Tensor]:
    """Six cameras, fewer if it has fewer: their indices, intrinsics ``[N, 4]`` and sizes ``[N, 2]`` in pixels."""
    cameras = arrays_of_views(scene_of(scene).views)
    picks = torch.linspace(0, len(cameras["poses"]) - 1, CAMERAS).round().long().unique()
    return picks, cameras["intrinsics"][picks].double(), cameras["sizes"][picks].double()


def scaled(scene: PackedScene, side: int) -> PackedScene:
    """The scene with six of its cameras, no larger than ``side``, as if the head had been trained at that size."""
    picks, intrinsics, sizes = picked(scene)
    targets = (sizes * min(side / int(sizes.max()), 1.0)).round().clamp_min(1)
    shares = targets / sizes
    return sized(scene, intrinsics * shares.repeat(1, 2), targets, picks, float(shares.mean()))


def cropped(scene: PackedScene, width: int, height: int) -> PackedScene:
    """The scene with six of its cameras at one size, which shows the middle of their images; as :func:`scaled`."""
    picks, intrinsics, sizes = picked(scene)
    target = torch.tensor([width, height], dtype=sizes.dtype)
    shares = (target / sizes).amax(1, keepdim=True)
    lenses = intrinsics * shares
    lenses[:, 2:] -= (sizes * shares - target) / 2
    return sized(scene, lenses, target.expand_as(sizes), picks, float(shares.mean()))


def write_changed(out: Path, scene: Path, small: PackedScene) -> PackedScene:
    """Write a file with the cameras of ``small``; levels and steps are copied: the page decodes those of the file."""
    header = container.read_header(scene)
    meta = {**header.meta, **small.meta}
    del meta["sections"]
    assert small.cameras is not None
    dtypes = {name: section["dtype"] for name, section in STORED.items()}
    cameras = {f"cameras/{name}": small.cameras[name].numpy().astype(dtype) for name, dtype in dtypes.items()}
    unpacked = 4 * sum(value.numel() for value in (*small.field.values(), *small.head.values()))
    sections = {**container.read_sections(scene, header), **cameras}
    out.write_bytes(container.encode(meta, sections, unpacked=unpacked)[0])
    return read_scene(out)


def truths(scene: PackedScene, only: slice = slice(None)) -> list[dict[str, NDArray[np.float32]]]:
    """``rgb`` and ``base_rgb`` of each camera, or of some of them, by Python."""
    model = model_of(scene_of(scene))
    cameras = {name: value[only] for name, value in arrays_of_views(scene_of(scene).views).items()}
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
    return round(float(-10 * np.log10(np.mean((found - truth) ** 2) + 1e-12)), 2)


def compared(scene: Path, side: int = SIDE, *, half: bool = False) -> dict[str, Any]:
    """A packed scene in the page: sizes, times, and the PSNR of six images against Python's of the same file.

    Args:
        scene: written by ``sundae pack``.
        side: longest side of the images, pixels.
        half: also render in half precision; ``psnr_half`` is missing where that is impossible.
    """
    chromium = find_chromium()
    if chromium is None:
        sys.exit("no Chromium here: apt-get install chromium")
    with TemporaryDirectory() as folder:
        packed, html = Path(folder) / "a.sundae", Path(folder) / "a.html"
        small = write_changed(packed, scene, scaled(read_scene(scene), side))
        write_page(html, scene_of(small), packed.read_bytes(), title=scene.stem)
        images = truths(small)
        width, height = (int(length) for length in arrays_of_views(scene_of(small).views)["sizes"][0])
        row: dict[str, Any] = {"scene": scene.name, "bytes": scene.stat().st_size, "size": f"{width}x{height}"}
        row |= {"primitives": len(small.field["means"]), "head": bool(small.head)}
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
    """Images of all cameras by the page's renderer in half precision, head included; None without such an adapter.

    Returns:
        The adapter, and images ``[H, W, 3]`` in [0, 1].
    """
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
        sizes = arrays_of_views(scene_of(read_scene(packed)).views)["sizes"].tolist()
        files = [np.fromfile(f"{copy}.{i}", np.uint8) for i in range(len(sizes))]
        pixels = [file.reshape(height, width, 4) for file, (width, height) in zip(files, sizes, strict=True)]
        return adapter, [each[..., :3] / 255 for each in pixels]


def write_timing(
    folder: Path, scene: Path, sizes: Sequence[tuple[int, int]], frames: int = FRAMES, *, as_trained: bool = False
) -> None:
    """Write what times the page's passes on any machine with Node: ``node FOLDER/timing.mjs FOLDER``.

    Args:
        folder: takes the program, Dawn for this system, a scene for each size, and rows of Python's images in 16 bits.
        scene: written by ``sundae pack``.
        sizes: width and height of the images, pixels.
        frames: most frames of each kind.
        as_trained: leave the head at the scale of its training; otherwise it runs at the size of the images.
    """
    package = Path("node_modules") / "webgpu"
    dawn = f"{sys.platform}-{PROCESSORS.get(platform.machine(), platform.machine())}"
    shutil.copytree(WEB / "tests" / package / "dist" / dawn, folder / package / "dist" / dawn)
    for name in ("index.js", "package.json", "LICENSE.md"):
        shutil.copy(WEB / "tests" / package / name, folder / package / name)
    bundled("timing.ts", folder / "timing.mjs", "--platform=node", "--external:webgpu")
    scenes, whole = [], read_scene(scene)
    for width, height in sizes:
        file, step = f"{width}x{height}.sundae", -(-height // ROWS)
        small = cropped(whole, width, height)
        if as_trained:
            small = replace(small, meta=whole.meta)
        small = write_changed(folder / file, scene, small)
        images = truths(small, slice(COMPARED))
        for camera, image in enumerate(images):
            for name in ("base_rgb", "rgb") if small.head else ("base_rgb",):
                rows = (image[name][::step].clip(0, 1) * 65535).round().astype("<u2")
                rows.tofile(folder / f"{file}.{camera}.{name}")
        scenes.append({"file": file, "compared": list(range(len(images))), "step": step})
    task = {"name": scene.name, "frames": frames, "seconds": SECONDS_OF_FRAMES, "scenes": scenes}
    (folder / "task.json").write_text(json.dumps(task))


def timed(
    scene: Path, sizes: Sequence[tuple[int, int]], frames: int = FRAMES, *, as_trained: bool = False
) -> list[dict[str, Any]]:
    """Time the page's passes on this machine's GPU, a row for each size and with the head off and on.

    Raises:
        SystemExit: the packages of ``web/tests`` are missing, or there is no adapter.
    """
    if not has_packages():
        sys.exit("no Dawn for Node here: make browser installs it where it finds npm")
    with TemporaryDirectory() as folder:
        write_timing(Path(folder), scene, sizes, frames, as_trained=as_trained)
        words = ["node", str(Path(folder) / "timing.mjs"), folder]
        found = subprocess.run(words, check=False, stdout=subprocess.PIPE, text=True)
    rows = [json.loads(line) for line in found.stdout.splitlines()]
    if found.returncode != 0:
        sys.exit(rows[-1]["error"] if rows and "error" in rows[-1] else "Node failed; see above")
    return rows


def size_of(text: str) -> tuple[int, int]:
    width, height = map(int, text.split("x"))
    return width, height


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="written by sundae pack")
    parser.add_argument("--side", type=int, default=SIDE, help="longest side of the images, pixels")
    parser.add_argument("--half", action="store_true", help="render in half precision too")
    parser.add_argument("--dawn", type=size_of, nargs="+", metavar="SIZE", help="time the passes at sizes like 800x533")
    parser.add_argument("--frames", type=int, default=FRAMES, help="with --dawn: most frames of each kind")
    parser.add_argument("--as-trained", action="store_true", help="with --dawn: the head at the scale of its training")
    parser.add_argument("--folder", type=Path, help="with --dawn: write what it runs to this folder, and do not run it")
    options = parser.parse_args()
    if options.folder and (not options.dawn or options.folder.exists()):
        parser.error("--folder names a new folder, and needs --dawn")
    if options.dawn and options.folder:
        options.folder.mkdir(parents=True)
        write_timing(options.folder, options.scene, options.dawn, options.frames, as_trained=options.as_trained)
    elif options.dawn:
        for row in timed(options.scene, options.dawn, options.frames, as_trained=options.as_trained):
            print(json.dumps(row))
    else:
        print(json.dumps(compared(options.scene, options.side, half=options.half)))


if __name__ == "__main__":
    main()
