"""JOD (ColorVideoVDP) of films of a packed scene, with its head and without, beside films of a field of all Gaussians.

    pip install --target CVVDP --no-deps cvvdp ffmpeg-python future imageio einops huggingface_hub httpx2
    PYTHONPATH=CVVDP python benchmarks/films.py SMALL.sundae FULL.sundae bonsai -o benchmarks/results/films.jsonl

``film`` is the JOD of a whole film, in which flicker counts, and ``still`` the mean JOD of its frames, each by itself.
Cameras move from three of the scene's towards their neighbours. A film takes two minutes on two cores. Lines of ``-o``
take the place of those of the same capture; without it they are printed only.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp

import sundae_ns as sn

FRAMES, FPS, BETWEEN, PLACES = 20, 30, 30, 3  # two thirds of a second, at a second from a camera to its neighbour
SAME_WAY = 0.94  # cosine of 20 degrees


def neighbour_of(place: int, cameras: Sequence[sn.Camera]) -> int:
    """The nearest other camera that looks within 20 degrees of the same direction."""
    here = cameras[place]
    near = [i for i, c in enumerate(cameras) if i != place and float(c.pose[:, 2] @ here.pose[:, 2]) > SAME_WAY]
    return min(near, key=lambda i: float((cameras[i].center - here.center).norm()))


def between(a: sn.Camera, b: sn.Camera, share: float) -> sn.Camera:
    """A camera on the straight way from one to the other, with the image of the first."""
    poses = np.stack([camera.pose.double().numpy() for camera in (a, b)])
    pose = (1 - share) * poses[0] + share * poses[1]
    pose[:, :3] = Slerp([0, 1], Rotation.from_matrix(poses[:, :, :3]))([share]).as_matrix()[0]
    return sn.Camera.from_pose(torch.from_numpy(pose), a.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), a.width, a.height)


def film(scene: sn.Scene, path: list[sn.Camera], *, head: bool = True) -> torch.Tensor:
    """Images of a scene, ``[F, H, W, 3]`` from 0 to 1."""
    return torch.stack([sn.render(scene, camera, head=head).rgb for camera in path]).clamp(0, 1)


def rows_of(small: sn.Scene, full: sn.Scene, capture: str, metric: Any) -> list[dict[str, Any]]:
    """A row for each place: JOD of the film and of its frames, head on and off."""
    rows, cameras = [], small.cameras
    for place in (len(cameras) * (i + 1) // (PLACES + 1) for i in range(PLACES)):
        neighbour = neighbour_of(place, cameras)
        path = [between(cameras[place], cameras[neighbour], frame / BETWEEN) for frame in range(FRAMES)]
        truth = film(full, path)
        row: dict[str, Any] = {"capture": capture, "pair": [place, neighbour]}
        for name in ("on", "off"):
            made = film(small, path, head=name == "on")
            whole = metric.predict(made, truth, dim_order="FHWC", frames_per_second=FPS)[0]
            stills = [float(metric.predict(*each, dim_order="HWC")[0]) for each in zip(made, truth, strict=True)]
            row |= {f"film_{name}": round(float(whole), 3), f"still_{name}": round(sum(stills) / FRAMES, 3)}
        print(json.dumps(row), flush=True)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("small", type=Path, help="packed scene whose films are judged")
    parser.add_argument("full", type=Path, help="scene whose films they stand beside")
    parser.add_argument("capture", help="name of the capture")
    parser.add_argument("-o", "--out", type=Path, help="table of results")
    options = parser.parse_args()
    import pycvvdp

    metric = pycvvdp.cvvdp(display_name="standard_4k", device=torch.device("cpu"), quiet=True)
    rows = rows_of(sn.load(options.small), sn.load(options.full), options.capture, metric)
    if options.out is not None:
        lines = options.out.read_text().splitlines() if options.out.exists() else []
        kept = [line for line in lines if json.loads(line)["capture"] != options.capture]
        options.out.write_text("".join(f"{line}\n" for line in [*kept, *map(json.dumps, rows)]))


if __name__ == "__main__":
    main()
