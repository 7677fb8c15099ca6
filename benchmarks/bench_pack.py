"""Measure packed scenes: bytes, bits a Gaussian, quality and seconds; print one JSON line.

    python benchmarks/bench_pack.py                              # 1,000,000 random Gaussians
    python benchmarks/bench_pack.py --run RUN --views 6          # a finished run, at its training resolution
    python benchmarks/bench_pack.py --run RUN --set harmonics_step=0.04 feature_step=0.3
    python benchmarks/bench_pack.py --run RUN --views 99 --finetune 1000                # as sundae pack --finetune 1000
    python benchmarks/bench_pack.py --packed scene.sundae --repeats 10                  # only opens it

Random Gaussians have no structure for an entropy coder; they measure time. A run is rendered before and after packing:
``psnr``, ``ssim`` and ``psnr_packed``, ``ssim_packed`` are against the test images, with the head and without
(``_base``); ``psnr_between`` compares the two renderings. With ``--finetune`` the packed model trains with rounding and
the rate in the loop, from the coarser options of ``FINETUNED``, which ``--set`` changes. ``--keep`` keeps the packed
file. ``s_first_image`` is a new Python process that imports the library, opens the file and renders one view. Lines
belong in results/pack.jsonl.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from statistics import mean, median
from typing import Any

import torch
from rich.progress import Progress, track
from torch import Tensor

from sundae_ns.core.metrics import psnr, ssim
from sundae_ns.head.head import CompensationHead, HeadConfig
from sundae_ns.io.config_file import load_config
from sundae_ns.io.pack.codecs import Codecs
from sundae_ns.io.pack.config import FINETUNED, PackConfig
from sundae_ns.io.pack.packed_scene import PackedScene, PackReport, fit_scene, read_scene, write_fitted
from sundae_ns.plugin.finetune import RATE, finetune
from sundae_ns.plugin.finished_runs import load_model, load_run
from sundae_ns.scene.packing import contents_of

FIRST_IMAGE = """
import sys
import sundae_ns as sn
scene = sn.load(sys.argv[1])
cameras = scene.cameras or sn.virtual_cameras(scene, 1, size=640)
sn.render(scene, cameras[0])
"""


def random_scene(n: int) -> PackedScene:
    g = torch.Generator().manual_seed(0)
    features = 13
    gaussians = {
        "means": torch.randn(n, 3, generator=g),
        "scales": 0.8 * torch.randn(n, 3, generator=g) - 5,
        "quats": torch.randn(n, 4, generator=g),
        "features_dc": 0.5 * torch.randn(n, 3, generator=g),
        "features_rest": 0.05 * torch.randn(n, 15, 3, generator=g),
        "opacities": 2 * torch.randn(n, 1, generator=g),
        "features": torch.randn(n, features, generator=g),
    }
    torch.manual_seed(0)
    return PackedScene(gaussians, dict(CompensationHead(HeadConfig(num_features=features)).state_dict()))


def config_of(settings: list[str], finetuned: bool) -> PackConfig:
    kinds: dict[str, Any] = {gaussians.name: type(gaussians.default) for gaussians in fields(PackConfig)}
    values: dict[str, Any] = dict(FINETUNED) if finetuned else {}
    for setting in settings:
        name, _, value = setting.partition("=")
        values[name] = kinds[name](value)
    return PackConfig(**values)


def prepared(
    run: Path | None, scene: PackedScene, config: PackConfig, steps: int, rate: float
) -> tuple[PackedScene, Codecs, list[float]]:
    """The scene to write, fine-tuned for ``steps``, its codecs, and the loss of each step."""
    losses: list[Tensor] = []
    if run is None or steps == 0:
        return *fit_scene(scene, config), []
    with Progress(transient=True) as progress:
        task = progress.add_task("Fine-tuning", total=steps)

        def note(loss: Tensor) -> None:
            losses.append(loss.clone())
            progress.advance(task)

        scene, codecs = finetune(run, scene, config, steps, rate=rate, progress=note)
        return scene, codecs, torch.stack(losses).tolist()


def seconds(action: Callable[[], Any]) -> tuple[float, float]:
    """Wall-clock seconds, and processor seconds of all cores."""
    start, busy = time.perf_counter(), time.process_time()
    action()
    return time.perf_counter() - start, time.process_time() - busy


def opening(file: Path, repeats: int) -> dict[str, Any]:
    """Seconds of unpacking in this process, and of the first image in a new one, after one of each that is not counted.

    A file without cameras is seen from outside.
    """
    times = [seconds(lambda: read_scene(file)) for _ in range(repeats + 1)][1:]
    command = [sys.executable, "-c", FIRST_IMAGE, str(file)]
    images = [seconds(lambda: subprocess.run(command, check=True))[0] for _ in range(repeats + 1)][1:]
    return {
        "s_unpack": round(median(clock for clock, _ in times), 3),
        "s_unpack_best": round(min(times)[0], 3),
        "s_unpack_worst": round(max(times)[0], 3),
        "core_s_unpack": round(median(busy for _, busy in times), 3),
        "s_first_image": round(median(images), 3),
        "s_first_image_best": round(min(images), 3),
    }


def sizes(report: PackReport) -> dict[str, Any]:
    return {
        "primitives": report.primitives,
        "bytes": report.bytes,
        "bits": {name: round(bits, 2) for name, bits in report.bits.items()},
        "bytes_a_primitive_without_head": round(
            (report.bytes - report.bits.get("head", 0.0) * report.primitives / 8) / report.primitives, 2
        ),
    }


@torch.no_grad()
def quality(run: Path, file: Path, cameras: int) -> dict[str, Any]:
    before = load_model(run / "config.yml")
    after = load_model(file, data=before.capture).model
    chosen = torch.linspace(0, len(before.cameras) - 1, min(cameras, len(before.cameras))).round().long().tolist()
    names = ("psnr", "psnr_packed", "psnr_between", "ssim", "ssim_packed")
    sums = {name + suffix: 0.0 for name in names for suffix in ("", "_base")}
    for i in track(chosen, description="Rendering", transient=True):
        camera, truth = before.cameras[i], before.truths[i]
        images = [model.get_outputs_for_camera(camera) for model in (before.model, after)]
        for suffix, output in (("", "rgb"), ("_base", "base_rgb")):
            old, new = (image[output].clamp(0, 1) for image in images)
            # Errors of all views together: PSNR is their logarithm.
            pairs = (old, truth), (new, truth), (new, old), (old, truth), (new, truth)
            for name, (a, b) in zip(names, pairs, strict=True):
                value = float((ssim if name.startswith("ssim") else psnr)(a, b))
                sums[name + suffix] += (10 ** (-value / 10) if name == "psnr_between" else value) / len(chosen)
    for name in ("psnr_between", "psnr_between_base"):
        sums[name] = -10 * torch.tensor(sums[name]).log10().item()
    camera = before.cameras[0]
    return {
        "views": len(chosen),
        "width": int(camera.width),
        "height": int(camera.height),
        "rasterizer": before.model.backend.name,
        "keep_ratio": None if before.kept is None else round(before.kept, 4),
        **{name: round(value, 4) for name, value in sums.items()},
    }


def scene_name(run: Path) -> str:
    """The capture's name, from the folder that the run's configuration names."""
    opened = load_config(run / "config.yml")
    return Path(opened.pipeline.datamanager.data or opened.data).name


def commit() -> str | None:
    """The checked-out commit; None outside of a repository."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip() or None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--primitives", type=int, default=1_000_000)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--set", nargs="*", default=[], metavar="OPTION=VALUE", help="fields of PackConfig")
    parser.add_argument(
        "--finetune", type=int, default=0, metavar="STEPS", help="train with rounding in the loop first"
    )
    parser.add_argument("--rate", type=float, default=RATE, help="loss for each bit per stored number in the fine-tune")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="keep the packed scene here")
    parser.add_argument("--packed", type=Path, metavar="FILE", help="open this packed scene, and pack nothing")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()

    torch.set_num_threads(options.threads)
    if options.packed is not None:
        print(json.dumps({"threads": options.threads, **opening(options.packed, options.repeats), "commit": commit()}))
        return
    config = config_of(options.set, options.finetune > 0)
    steps = options.finetune
    scene = random_scene(options.primitives) if options.run is None else contents_of(load_run(options.run))
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "scene.sundae"
        start = time.perf_counter()
        scene, codecs, losses = prepared(options.run, scene, config, steps, options.rate)
        tuning = time.perf_counter() - start
        report = write_fitted(file, scene, codecs)
        packing = time.perf_counter() - start - (tuning if steps else 0)
        result = {
            "run": None if options.run is None else scene_name(options.run),
            "set": options.set,
            "finetune_steps": steps,
            "rate": options.rate if steps else 0.0,
            "threads": options.threads,
            **sizes(report),
            "s_pack": round(packing, 2),
            **opening(file, options.repeats),
        }
        if losses:
            tenth = max(len(losses) // 10, 1)
            result["s_finetune"] = round(tuning, 1)
            result["loss_first_last_tenth"] = [round(mean(part), 5) for part in (losses[:tenth], losses[-tenth:])]
        if options.run is not None:
            result |= quality(options.run, file, options.views)
        if options.keep is not None:
            shutil.copy(file, options.keep)
        result["commit"] = commit()
    print(json.dumps(result))


if __name__ == "__main__":
    main()
