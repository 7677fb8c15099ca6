"""Seconds of a plane sweep alone on the device: python lab/sweep_time.py CAPTURE SIDE VIEWS"""
import sys, time
from pathlib import Path
import torch
from sundae_ns.training import plane_sweep
from sundae_ns.training.plane_sweep import Sweep
from sundae_ns.training.extension import Photo
from sundae_ns.rendering.views import View
from nerfstudio.data.utils.colmap_parsing_utils import read_cameras_binary, read_images_binary, read_points3D_binary, qvec2rotmat
from PIL import Image
import numpy as np
root, dev = Path(sys.argv[1]), "cuda" if torch.cuda.is_available() else "cpu"
cams, ims = read_cameras_binary(root / "sparse/0/cameras.bin"), read_images_binary(root / "sparse/0/images.bin")
pts = torch.tensor(np.stack([p.xyz for p in read_points3D_binary(root / "sparse/0/points3D.bin").values()]), dtype=torch.float32, device=dev)
photos = []
for im in sorted(ims.values(), key=lambda i: i.name)[: int(sys.argv[3])]:
    cam = cams[im.camera_id]
    m = torch.eye(4); m[:3, :3] = torch.tensor(qvec2rotmat(im.qvec)); m[:3, 3] = torch.tensor(im.tvec)
    p = list(cam.params)
    f = p if cam.model in ("PINHOLE", "OPENCV") else [p[0], p[0], p[1], p[2]]
    K = torch.tensor([[f[0], 0, f[2]], [0, f[1], f[3]], [0, 0, 1]], dtype=torch.float32)
    img = torch.tensor(np.asarray(Image.open(root / "images" / im.name).convert("RGB")), device=dev).float() / 255
    K[0] *= img.shape[1] / cam.width; K[1] *= img.shape[0] / cam.height
    photos.append(Photo(View(m.to(dev), K.to(dev), img.shape[1], img.shape[0], float(K[0, 0])), img, None))
def timed(name, side):
    torch.cuda.synchronize() if dev == "cuda" else None
    t = time.time(); s = Sweep(photos, pts, side); torch.cuda.synchronize() if dev == "cuda" else None
    a = time.time()
    for i in range(len(photos)): s.add(i)
    torch.cuda.synchronize() if dev == "cuda" else None
    b = time.time(); xyz, _ = s.points(100_000); torch.cuda.synchronize() if dev == "cuda" else None
    print(f"SWEEPTIME {root.name} {name} side {side}: reduce {a-t:.2f} s, sweep {b-a:.2f} s ({1000*(b-a)/len(photos):.0f} ms a view), points {time.time()-b:.2f} s, {len(xyz)} points", flush=True)
with torch.no_grad():
    for side in map(int, sys.argv[2].split(",")):
        timed("first", side)
        timed("again", side)
    if dev == "cuda":
        from torch.profiler import ProfilerActivity, profile
        s = Sweep(photos, pts, 640)
        with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as prof:
            for i in range(4): s.add(i)
            torch.cuda.synchronize()
        print("\n".join(line[:60] + line[-150:] for line in prof.key_averages().table(sort_by="cuda_time_total", row_limit=14).splitlines()))
        for side in map(int, sys.argv[2].split(",")):
            kernels, plane_sweep._kernels = plane_sweep._kernels, lambda image: None
            few, photos[:] = list(photos), photos[:40]
            timed("pytorch, 40 views", side)
            plane_sweep._kernels = kernels
            timed("kernel, 40 views", side)
            photos[:] = few
