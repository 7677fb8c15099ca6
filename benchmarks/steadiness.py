"""Flicker along a camera path, with the head and without: python benchmarks/steadiness.py --load-config RUN/config.yml.

The path runs from test camera to test camera (nerfstudio's interpolation). Between neighbouring frames the camera's motion is
taken out by depth (``sundae_ns.evaluation.change``); what is left is flicker, and a little of what bilinear sampling does,
which both pictures share. Writes results/steadiness.json.

``--reference`` measures the pictures of another run on the same capture as well, by the depth of the first: those of the full
field, say, which are steady by construction. What they show is what detail and the error of the depth alone amount to.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import mean

import torch
from nerfstudio.cameras.camera_paths import get_interpolated_camera_path
from nerfstudio.cameras.cameras import Cameras
from rich.progress import track

from sundae_ns.compensation import PHASES
from sundae_ns.evaluation import Frame, change
from sundae_ns.scenes.opening import load_run

RESULTS = Path(__file__).parent / "results" / "steadiness.json"


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--load-config", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=30, help="frames from one test camera to the next")
    parser.add_argument(
        "--phases", type=int, choices=PHASES, help="how often the head runs a frame; default: the run's"
    )
    parser.add_argument("--reference", type=Path, help="config.yml of another run on the same capture")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    run = load_run(options.load_config)
    model, cameras = run.model, run.cameras
    if options.phases is not None and model.head is not None:
        model.head.config.phases = options.phases
    other = None if options.reference is None else load_run(options.reference).model
    first = cameras[0]
    stations = Cameras(
        torch.cat([camera.camera_to_worlds for camera in cameras]).cpu(),
        **{name: getattr(first, name).flatten()[0].item() for name in ("fx", "fy", "cx", "cy")},
        width=int(first.width),
        height=int(first.height),
    )
    path = get_interpolated_camera_path(stations, steps=options.steps, order_poses=True)
    background = model._get_background_color()
    changes: dict[str, list[float]] = {"rgb": [], "base_rgb": []} | ({} if other is None else {"reference": []})
    before: dict[str, Frame] = {}
    for i in track(range(len(path)), description="Frames"):
        view = model.view_of(path[i : i + 1])
        pictures, _ = model.render(model.gaussians, view, background)
        if other is not None:
            pictures["reference"] = other.render(other.gaussians, view, background)[0]["rgb"]
        for name, values in changes.items():
            frame = Frame(pictures[name], pictures["depth"], pictures["accumulation"], view.viewmat, view.K)
            if name in before:
                found = change(before[name], frame)
                if found.share > 0.1:
                    values.append(found.mean)
            before[name] = frame
    figures = {
        "phases": 0 if model.head is None else model.head.config.phases,
        "steps": options.steps,
        "frames": len(path),
        "pairs": len(changes["rgb"]),
        "change_with_head": mean(changes["rgb"]),
        "change_of_base_colours": mean(changes["base_rgb"]),
    }
    figures["ratio"] = figures["change_with_head"] / figures["change_of_base_colours"]
    if other is not None:
        figures["change_of_reference"] = mean(changes["reference"])
        figures["reference_ratio"] = figures["change_of_reference"] / figures["change_of_base_colours"]
    print(figures)
    options.out.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
