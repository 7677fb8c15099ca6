"""How visible a head is, in JOD and FLIP: films of a packed scene, head on and off, beside films of its full field.

    pip install cvvdp flip-evaluator
    cd benchmarks; python -m harness.films SMALL.sundae FULL.sundae CAPTURE -o results/films.jsonl

``film`` is the JOD of whole films, in which flicker counts, ``still`` the mean of their frames, each by itself; what a
film has less than its stills is motion. ``photo`` is the mean JOD of test photos, every eighth of a COLMAP capture, of
which ``--photos`` are looked at. 10 is the reference itself (``sundae_ns.evaluation.jod``). ``flip`` is the mean FLIP
of the frames, 0 for equal ones, if its package is installed.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from flicker import between, neighbours
from PIL import Image
from torch import Tensor

import sundae_ns as sn
from sundae_ns.data.camera_axes import world_to_camera
from sundae_ns.evaluation import flip, flip_available
from sundae_ns.evaluation.jod import INSTALL_JOD, jod, jod_available, jod_metric

FRAMES, FPS, BETWEEN = 20, 30, 30
"""Frames of a film, their number a second, and the number from one camera to its neighbour."""


def moved(views: list[sn.View], pair: tuple[int, int], share: float) -> sn.View:
    """The view a share of the way from one camera of a pair to the other."""
    first, second = (views[index] for index in pair)
    pose = between(first.pose.double(), second.pose.double(), share)
    return first._replace(viewmat=world_to_camera(pose).to(first.viewmat))


def film(scene: sn.Scene, views: list[sn.View], pair: tuple[int, int], *, head: bool) -> Tensor:
    """Frames ``[F, H, W, 3]`` from one camera of a pair towards the other."""
    shown = (sn.render(scene, moved(views, pair, k / BETWEEN), head=head).rgb for k in range(FRAMES))
    return torch.stack([image.clamp(0, 1) for image in shown])


def rows(small: sn.Scene, full: sn.Scene, capture: Path, places: int, photos: int) -> Any:
    """Figures of each path, and of the photos."""
    metric = jod_metric(small.device)
    views, others = (list(sn.views_of(capture / "sparse/0", scene)) for scene in (small, full))
    for pair in neighbours(torch.stack([view.pose for view in views]), places):
        reference = film(full, others, pair, head=True)
        row: dict[str, Any] = {"pair": pair}
        for name, head in (("on", True), ("off", False)):
            shown = film(small, views, pair, head=head)
            found, _ = metric.predict(shown, reference, dim_order="FHWC", frames_per_second=FPS)
            row[f"film_{name}"] = float(found)
            pairs = list(zip(shown, reference, strict=True))
            row[f"still_{name}"] = fmean(_value(jod(*pair)) for pair in pairs)
            if flip_available():
                row[f"flip_{name}"] = fmean(_value(flip(*pair)) for pair in pairs)
        yield row
    names = sorted(path.name for path in (capture / "images").iterdir())[::8]
    row = {"photos": min(photos, len(names))}
    every = np.linspace(0, len(names) - 1, row["photos"]).round().astype(int).tolist()
    for name, head in (("on", True), ("off", False)):
        row[f"photo_{name}"] = fmean(_of_photo(small, views[8 * i], capture / "images" / names[i], head) for i in every)
    yield row


def _of_photo(scene: sn.Scene, view: sn.View, path: Path, head: bool) -> float:
    with Image.open(path) as photo:
        truth = torch.from_numpy(np.asarray(photo.convert("RGB"), np.float32) / 255).to(scene.device)
    return _value(jod(sn.render(scene, view, head=head).rgb, truth[: view.height, : view.width]))


def _value(found: Tensor | None) -> float:
    assert found is not None, "its package is installed"
    return float(found)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("small", type=Path, help="packed scene with a head")
    parser.add_argument("full", type=Path, help="packed full field")
    parser.add_argument("capture", type=Path, help="folder with images and sparse/0")
    parser.add_argument("-o", "--out", type=Path, required=True, help="file to append lines of JSON to")
    parser.add_argument("--places", type=int, default=3, help="number of paths")
    parser.add_argument("--photos", type=int, default=8, help="number of test photos")
    args = parser.parse_args()
    if not jod_available():
        parser.error(f"JOD needs a package: {INSTALL_JOD}")
    for row in rows(sn.load(args.small), sn.load(args.full), args.capture, args.places, args.photos):
        rounded = {key: round(value, 3) if isinstance(value, float) else value for key, value in row.items()}
        with args.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"capture": args.capture.name, **rounded}) + "\n")


if __name__ == "__main__":
    main()
