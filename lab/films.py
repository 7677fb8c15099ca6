"""JOD (ColorVideoVDP) of films of a packed scene, head on and off, beside films of its full field, on a CPU.

    pip install --target /tmp/cvvdp --no-deps cvvdp ffmpeg-python future imageio einops huggingface_hub httpx2
    PYTHONPATH=.:/tmp/cvvdp python lab/films.py SMALL.sundae FULL.sundae CAPTURE benchmarks/results/films.jsonl

``film`` is the JOD of a whole film, in which flicker counts; ``still`` is the mean JOD of its frames, each by itself.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pycvvdp
import torch
from scipy.spatial.transform import Rotation, Slerp

import sundae_ns as sn

FRAMES, FPS, BETWEEN, PLACES = 20, 30, 30, 3  # two thirds of a second, at a second from a camera to its neighbour
small, full = (sn.load(path) for path in sys.argv[1:3])
capture, out = sys.argv[3], Path(sys.argv[4])
cameras = small.cameras
metric = pycvvdp.cvvdp(display_name="standard_4k", device=torch.device("cpu"), quiet=True)


def neighbour(place):
    """The nearest camera that looks within 20 degrees of the same direction."""
    here = cameras[place]
    near = [i for i, c in enumerate(cameras) if i != place and float(c.pose[:, 2] @ here.pose[:, 2]) > 0.94]
    return min(near, key=lambda i: float((cameras[i].center - here.center).norm()))


def moved(a, b, share):
    poses = np.stack([c.pose.double().numpy() for c in (a, b)])
    pose = (1 - share) * poses[0] + share * poses[1]
    pose[:, :3] = Slerp([0, 1], Rotation.from_matrix(poses[:, :, :3]))([share]).as_matrix()[0]
    return sn.Camera.from_pose(torch.from_numpy(pose), a.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), a.width, a.height)


rows = []
for place in (len(cameras) * (i + 1) // (PLACES + 1) for i in range(PLACES)):
    pair = place, neighbour(place)
    path = [moved(*(cameras[i] for i in pair), k / BETWEEN) for k in range(FRAMES)]
    films = {
        "on": [sn.render(small, c).rgb for c in path],
        "off": [sn.render(small, c, head=False).rgb for c in path],
        "full": [sn.render(full, c).rgb for c in path],
    }
    films = {name: torch.stack(frames).clamp(0, 1) for name, frames in films.items()}
    row = {"capture": capture, "pair": pair}
    for name in ("on", "off"):
        row[f"film_{name}"] = round(float(metric.predict(films[name], films["full"], dim_order="FHWC", frames_per_second=FPS)[0]), 3)
        stills = [float(metric.predict(a, b, dim_order="HWC")[0]) for a, b in zip(films[name], films["full"])]
        row[f"still_{name}"] = round(sum(stills) / FRAMES, 3)
    rows.append(row)
    print(json.dumps(row), flush=True)
kept = [line for line in out.read_text().splitlines() if json.loads(line)["capture"] != capture] if out.exists() else []
out.write_text("".join(f"{line}\n" for line in [*kept, *map(json.dumps, rows)]))
