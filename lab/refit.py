"""python lab/refit.py CAPTURE: the refit of a prune with more steps, larger or more views. Wants /tmp/full/CAPTURE.sundae."""
import json, subprocess, sys, time
from pathlib import Path
import torch
sys.path.insert(0, "/tmp/repo/benchmarks")
import prune_without_photos as bench
import sundae_ns as sn
from sundae_ns.api import pruning, refit
name = sys.argv[1]
subprocess.run(["sundae", "unpack", f"/tmp/full/{name}.sundae", "--data", f"/tmp/scenes/{name}", "-o", f"/tmp/unpacked/{name}"], check=True)
full = bench.full_field(next(Path(f"/tmp/unpacked/{name}").rglob("config.yml")).parent, None)
out = open(f"/tmp/out/refit-{name}.jsonl", "w", buffering=1)
for keep in (0.1, 0.5):
    for steps, size, number, four in ((0, 256, 128, 4), (64, 256, 128, 4), (256, 256, 128, 4), (1000, 256, 128, 4), (256, 512, 128, 4), (256, 256, 512, 4), (1000, 512, 512, 4), (256, 512, 256, 4)):
        refit.STEPS, refit.VIEWS, refit.MOST_PIXELS = max(steps, 1), four, size * size
        torch.cuda.synchronize(); began = time.monotonic()
        views = sn.virtual_views(full.scene, number, size=size)
        torch.cuda.synchronize(); looked = time.monotonic()
        pruning.refit = refit.refit if steps else lambda small, *a, **k: small
        small = sn.prune(full.scene, keep=keep, views=views)
        torch.cuda.synchronize(); done = time.monotonic()
        to = sn.measure(small, full.images, full.views); photo = sn.measure(small, full.photos, full.views)
        row = dict(capture=name, keep=keep, steps=steps, size=size, number=number, four=four, to=round(to.psnr, 3), psnr=round(photo.psnr, 3), ssim=round(photo.ssim, 4), views_s=round(looked - began, 2), prune_s=round(done - looked, 2))
        out.write(json.dumps(row) + "\n"); print(row, flush=True)
