"""How many primitives a CPU and a GPU choose differently.

    python benchmarks/selections.py CONFIG... [--views 16] [--factor 0.5]

Each run is of a field that has not been pruned. ``differ_given`` counts where both are given the weights that the GPU found,
``differ_whole`` where the CPU splats the views itself too, and ``differ_again`` is the GPU's choice made twice. The error is
the norm of the difference of the weights over the norm of the GPU's. A line for each rule and budget goes to
``benchmarks/results/selections.jsonl``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import run
import torch
from rich.progress import track
from rules import PLAIN, RULES
from torch import Tensor

from sundae_ns.pruning import PruningConfig, decide
from sundae_ns.rasterization import select_backend
from sundae_ns.rendering.render import Style, weights_of
from sundae_ns.rendering.views import View
from sundae_ns.scenes.opening import open_pipeline

RESULTS = Path(__file__).parent / "results" / "selections.jsonl"
COMPARED = ("paper", "contribution", "response-contribution", "systematic-merge", "detail-merge")


def on_cpu(view: View) -> View:
    return view._replace(viewmat=view.viewmat.cpu(), K=view.K.cpu())


def weights(
    params: Mapping[str, Tensor], views: list[View], background: Tensor, style: Style, share: float | None
) -> Tensor:
    """Blending weights over some views ``[N]``, as ``SundaeModel.contribution`` sums them."""
    total = torch.zeros(len(params["means"]), device=params["means"].device)
    for view in track(views, description=f"Contribution on {total.device.type}", transient=True):
        total += weights_of(params, view, background.to(total.device), style, share)
    return total


@torch.no_grad()
def compare(path: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    _, pipeline, model, step, _ = open_pipeline(path)
    pipeline.eval()
    cameras = [camera for camera, _ in pipeline.datamanager.training_views()]
    chosen = torch.linspace(0, len(cameras) - 1, options.views).round().long().unique().tolist()
    views = [model.view_of(cameras[i]).zoomed(options.factor) for i in chosen]
    gpu = {name: value.detach() for name, value in model.gaussians.items()}
    cpu = {name: value.cpu() for name, value in gpu.items()}
    here = [on_cpu(view) for view in views]
    there = replace(model._style, head=None)
    elsewhere = replace(there, backend=select_backend("auto", "cpu"))
    found: dict[float | None, tuple[Tensor, Tensor]] = {}
    lines = []
    for rule in COMPARED:
        for keep in options.keep:
            config = replace(PruningConfig(), keep_ratio=keep, **{**PLAIN, **RULES[rule]})
            share = keep if config.uses_detail else None
            if share not in found:
                background = model.background_color
                found[share] = (
                    weights(gpu, views, background, there, share),
                    weights(cpu, here, background, elsewhere, share),
                )
            on_gpu, by_cpu = found[share]

            def kept(field: Mapping[str, Tensor], given: Tensor, config: PruningConfig = config) -> Tensor:
                return decide(field, config, lambda: given).mask.cpu()

            first, again = kept(gpu, on_gpu), kept(gpu, on_gpu)
            given, whole = kept(cpu, on_gpu.cpu()), kept(cpu, by_cpu)
            error = (by_cpu - on_gpu.cpu()).double().norm() / on_gpu.double().norm().cpu()
            line = {
                "scene": path.parent.name,
                "step": step,
                "rule": rule,
                "keep": keep,
                "primitives": len(first),
                "kept": int(first.sum()),
                "differ_again": int((again & ~first).sum()),
                "differ_given": int((given & ~first).sum()),
                "differ_whole": int((whole & ~first).sum()),
                "weights_rel_error": float(error),
                "views": len(views),
                "width": views[0].width,
                "height": views[0].height,
                "cpu_rasterizer": type(elsewhere.backend).__name__,
                "gpu": torch.cuda.get_device_name(),
                "commit": run.commit(),
            }
            print(json.dumps(line), flush=True)
            lines.append(line)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("configs", type=Path, nargs="+")
    parser.add_argument("--keep", type=float, nargs="+", default=[0.01, 0.1])
    parser.add_argument("--views", type=int, default=16, help="training views, evenly chosen")
    parser.add_argument("--factor", type=float, default=0.5, help="on the sides of the views")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("there is no CUDA device to compare the CPU with; sundae doctor says more")
    for path in options.configs:
        for line in compare(path, options):
            run.append_line(options.results, line)


if __name__ == "__main__":
    main()
