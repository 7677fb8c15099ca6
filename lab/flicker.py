"""Flicker of the head along a camera path: python lab/flicker.py RUN DATA [OTHER]

With OTHER, a run of the same capture, its images take the place of the compensated ones.

As StopThePop measures popping: frames k = 1 and 7 apart, the earlier warped onto the later, squared error, the per-pixel minimum
over both methods (base colours, compensated) subtracted. Warps go by the depth of the field, in place of optical flow.
"""
import json, sys
from pathlib import Path
import torch, torch.nn.functional as F
from sundae_ns.rendering.render import render
from sundae_ns.rendering.views import view_of
from sundae_ns.scenes.opening import open_scene

PLACES, FRAMES, PER_PAIR = 3, 15, 20
run, data = Path(sys.argv[1]), Path(sys.argv[2])
opened = open_scene(run, data=data)
model, dm = opened.model, opened.datamanager
model.eval()
other = open_scene(Path(sys.argv[3]), data=data).model.eval() if len(sys.argv) > 3 else None
cameras, names = dm.train_dataset.cameras, dm.train_dataset.image_filenames
order = sorted(range(len(names)), key=lambda i: names[i].name)


def path(place):
    a, b = order[place], order[place + 1]
    p, q = cameras.camera_to_worlds[a].double(), cameras.camera_to_worlds[b].double()
    for i in range(FRAMES):
        t = i / PER_PAIR
        pose = (1 - t) * p + t * q
        u, _, v = torch.linalg.svd(pose[:, :3])
        pose[:, :3] = u @ v
        camera = cameras[a : a + 1]
        yield view_of(camera, "cpu", pose=pose.float())


@torch.no_grad()
def frame(view):
    images, _ = render(model.source, view, model.shown_background, model.render_settings(training=False), depth=True)
    if other is not None:
        images["rgb"] = render(other.source, view, other.shown_background, other.render_settings(training=False), depth=False)[0]["rgb"]
    return {k: images[k].float() for k in ("rgb", "base_rgb", "depth", "accumulation")}, view


def warped(before, after):
    """Colours of ``before`` in the pixels of ``after``, both variants, and the pixels that both see."""
    (a, va), (b, vb) = before, after
    height, width, _ = b["rgb"].shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(vb.K).T
    motion = va.viewmat @ torch.linalg.inv(vb.viewmat)
    points = (rays * b["depth"]) @ motion[:3, :3].T + motion[:3, 3]
    z = points[..., 2:]
    grid = 2 * (points @ va.K.T)[..., :2] / z.clamp_min(1e-8) / torch.tensor([width, height]) - 1
    stack = torch.cat([a["rgb"], a["base_rgb"], a["depth"], a["accumulation"]], -1).permute(2, 0, 1)[None]
    s = F.grid_sample(stack, grid[None], mode="bicubic", padding_mode="border", align_corners=False)[0].permute(1, 2, 0)
    seen = ((z > 0) & (grid.abs() <= 1).all(-1, keepdim=True) & ((s[..., 6:7] - z).abs() <= 0.02 * z) & (torch.minimum(s[..., 7:], b["accumulation"]) > 0.95))[..., 0]
    return s[..., :3], s[..., 3:6], seen


sums = {k: torch.zeros(6, dtype=torch.float64) for k in (1, 7)}
for place in torch.linspace(0, len(order) - 2, PLACES + 2).long().tolist()[1:-1]:
    frames = [frame(view) for view in path(place)]
    for k in sums:
        for i in range(len(frames) - k):
            head, base, seen = warped(frames[i], frames[i + k])
            e_head = (head - frames[i + k][0]["rgb"]).square().mean(-1)[seen].double()
            e_base = (base - frames[i + k][0]["base_rgb"]).square().mean(-1)[seen].double()
            least = torch.minimum(e_head, e_base)
            sums[k] += torch.stack([e_head.sum(), e_base.sum(), (e_head - least).sum(), (e_base - least).sum(), seen.sum().double(), torch.tensor(seen.numel()).double()])
for k, s in sums.items():
    s = s.tolist()
    print(json.dumps({"run": str(run.name), "frames_apart": k, "mse_head": s[0] / s[4], "mse_base": s[1] / s[4], "over_min_head": s[2] / s[4], "over_min_base": s[3] / s[4], "seen": s[4] / s[5]}), flush=True)
