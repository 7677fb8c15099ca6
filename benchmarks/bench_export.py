"""Read exported files of a run back by another program, and render them; print one JSON line for each file.

    npm install @playcanvas/splat-transform          # needs node 22; or have it in PATH
    python benchmarks/bench_export.py --run RUN --views 4 --downscale 2

``splat-transform`` turns each file into a .ply, which the run's own rasteriser renders without the head. ``psnr`` is
against the test images, ``psnr_model`` that of the model's own base colours, and ``psnr_between`` compares the two
renderings. ``theirs`` are the files that splat-transform makes of our .ply, for comparison. Lines belong in
results/exports.jsonl.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

import torch
from rich.progress import track
from torch import Tensor
from torch.nn.functional import avg_pool2d

from sundae_ns.api.files import load, save
from sundae_ns.evaluation import psnr
from sundae_ns.gaussians.gaussians import Field
from sundae_ns.rendering import LocalField, render_view
from sundae_ns.scenes.models import Opened, load_model
from sundae_ns.storage.formats import ANTIALIASED
from sundae_ns.storage.ply import read_ply


def transform(program: str, source: Path, out: Path) -> Path:
    """Convert a file by splat-transform, without a GPU."""
    subprocess.run([program, "--quiet", "--overwrite", "--gpu", "cpu", str(source), str(out)], check=True)
    return out


def says_antialiased(ply: Path) -> bool:
    with ply.open("rb") as file:
        return ANTIALIASED.encode() in file.read(4096).partition(b"end_header")[0]


def smaller(image: Tensor, factor: int) -> Tensor:
    """Means of squares of pixels ``[H, W, 3]``."""
    return avg_pool2d(image.permute(2, 0, 1), factor).permute(1, 2, 0)


@torch.no_grad()
def images_of(run: Opened, field: Mapping[str, Tensor], views: list[int], downscale: int, text: str) -> list[Tensor]:
    model = run.model
    background, settings = model._get_background_color(), model.render_settings(training=False).without_head()
    made = []
    for i in track(views, description=text, transient=True):
        view = model.view_of(run.cameras[i], downscale)
        made.append(render_view(LocalField(Field(dict(field))), view, background, settings, depth=False)[0]["base_rgb"])
    return made


def mean_psnr(images: list[Tensor], truths: list[Tensor]) -> float:
    return round(sum(float(psnr(a, b)) for a, b in zip(images, truths, strict=True)) / len(truths), 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--splat-transform", default=shutil.which("splat-transform"))
    options = parser.parse_args()
    if options.splat_transform is None:
        parser.error(
            "splat-transform is not in PATH; npm install @playcanvas/splat-transform, or give --splat-transform"
        )

    run = load_model(options.run / "config.yml")
    model = run.model
    scene = load(options.run)
    views = torch.linspace(0, len(run.cameras) - 1, min(options.views, len(run.cameras))).round().long().tolist()
    own = images_of(run, dict(model.gauss_params), views, options.downscale, "The model")
    truths = [
        smaller(run.truths[i], options.downscale)[: p.shape[0], : p.shape[1]] for i, p in zip(views, own, strict=True)
    ]
    # From here on the colours are SH coefficients, whatever the model has.
    model.config.sh_degree = max(model.config.sh_degree, 1)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind in ("ply", "spz", "sog"):
            save(scene, folder / f"ours.{kind}")
        files = [folder / f"ours.{kind}" for kind in ("ply", "spz", "sog")]
        files += [transform(options.splat_transform, files[0], folder / f"theirs.{kind}") for kind in ("spz", "sog")]
        for file in files:
            back = transform(options.splat_transform, file, folder / "back.ply")
            field = {key: value.to(model.device) for key, value in read_ply(back).items()}
            images = images_of(run, field, views, options.downscale, file.name)
            squared = sum(float(((a - b) ** 2).mean()) for a, b in zip(images, own, strict=True)) / len(own)
            result = {
                "run": options.run.resolve().parents[1].name,
                "file": file.name,
                "bytes": file.stat().st_size,
                "primitives": len(field["means"]),
                "antialiased": scene.antialiased,
                "antialiased_back": says_antialiased(back),
                "views": len(views),
                "width": own[0].shape[1],
                "height": own[0].shape[0],
                "rasterizer": model.backend.name,
                "psnr_model": mean_psnr(own, truths),
                "psnr": mean_psnr(images, truths),
                "psnr_between": None if squared == 0 else round(-10 * torch.tensor(squared).log10().item(), 2),
            }
            print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
