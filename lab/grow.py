"""A field grown on a CPU from a capture, in minutes: grow.py CAPTURE COUNT OUT.ply [STEPS a size, 60 by default].

Gaussians of the sparse points double until COUNT by splits where gradients are high; it has 14 to 20 dB.
"""

import dataclasses
import math
import sys
from pathlib import Path

import cv2
import torch

import sundae_ns as sn
from sundae_ns.core.camera import Camera
from sundae_ns.core.covariance import rotation_matrices
from sundae_ns.data.colmap import read_images, read_points
from sundae_ns.scene.cameras import _of_colmap
from sundae_ns.scene.prune_scene import _blended, at_most

capture, count, out = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
steps = int(sys.argv[4]) if len(sys.argv) > 4 else 60
torch.manual_seed(0)
images = sorted(read_images(capture / "sparse/0").values(), key=lambda image: image.name)
views = []
for image in images[:: max(1, len(images) // 90)]:
    camera = at_most(Camera.from_pose(*_of_colmap(image, {}, "")), 1 << 18)
    views.append((camera, cv2.imread(str(capture / "images" / image.name))[..., ::-1]))
extent = float(torch.stack([camera.center for camera, _ in views]).std(dim=0).norm())
scene = sn.Scene.from_points(*map(torch.from_numpy, read_points(capture / "sparse/0")), sh_degree=3)
field, settings = scene.gaussians, scene.settings(head=False)
field = field.replaced({"opacities": torch.zeros_like(field["opacities"])})
rates = {"scales": 0.02, "quats": 0.005, "opacities": 0.06, "features_dc": 0.015, "features_rest": 0.0015}
while True:
    values = {name: field[name].clone().requires_grad_() for name in field}
    rates["means"] = 0.12 * float(field["scales"].exp().mean(dim=1).median())
    adam = torch.optim.Adam([{"params": [values[name]], "lr": rates[name]} for name in rates], eps=1e-15)
    decay = torch.optim.lr_scheduler.LinearLR(adam, 1.0, 0.15, steps)
    score, seen, error = torch.zeros(len(field["means"])), torch.zeros(len(field["means"])), 0.0
    for i in (torch.randperm(steps) % len(views)).tolist():
        camera = views[i][0].zoomed(0.5 if len(score) < 100_000 else 1.0)
        photo = cv2.resize(views[i][1], (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        off = _blended(field.replaced(values), [camera], settings)[0][..., :3] - torch.from_numpy(photo).float() / 255
        adam.zero_grad()
        (off.abs().mean() + 0.5 * off.square().mean() + 0.003 * values["opacities"].sigmoid().mean()).backward()
        change = values["means"].grad.norm(dim=1) * values["scales"].detach().exp().mean(dim=1)
        score, seen, error = score + change, seen + (change > 0), error + float(off.detach().square().mean()) / steps
        adam.step()
        decay.step()
    field = field.replaced({name: value.detach() for name, value in values.items()})
    print(f"{capture.name}: {len(score):,} Gaussians, {-10 * math.log10(error):.2f} dB", flush=True)
    if len(score) >= count:
        break
    kept = (field["opacities"].sigmoid()[:, 0] > 0.02) & (field["scales"].exp().amax(dim=1) < 3 * extent)
    field, score = field.rows(kept), (score / seen.clamp_min(1))[kept]
    chosen = score.topk(min(len(score), count - len(score))).indices
    part, others = field.rows(chosen), torch.ones_like(score, dtype=torch.bool).index_fill_(0, chosen, False)
    drawn = torch.randn(len(chosen), 3, 1) * part["scales"].exp()[..., None]
    moved = (rotation_matrices(part["quats"]) @ drawn)[..., 0]
    halves = [{**part, "means": part["means"] + side * moved, "scales": part["scales"] - 0.4} for side in (1, -1)]
    rest = field.rows(others)
    field = rest.replaced({name: torch.cat([rest[name], *(half[name] for half in halves)]) for name in rest})
sn.save(dataclasses.replace(scene, gaussians=field), out)
