"""Test views of a run with the shading that lab/hybrid.py learnt: python lab/shaded.py RUN/config.yml shading.pt OUT.json"""
import json, sys, torch
from pathlib import Path
from nerfstudio.utils.eval_utils import eval_setup

_, pipe, _, _ = eval_setup(Path(sys.argv[1]), test_mode="test")
a, found, plain = torch.load(sys.argv[2]), {}, pipe.model.get_outputs_for_camera
found["without"] = pipe.get_average_eval_image_metrics()
def shaded(camera, *args, **kwargs):
    out = plain(camera, *args, **kwargs)
    h, w = out["rgb"].shape[:2]
    y, x = ((torch.arange(n, device=out["rgb"].device) + 0.5 - n / 2) / (w / 2) for n in (h, w))
    r = (y[:, None] ** 2 + x[None] ** 2)[..., None]
    at = a.to(r)
    for name in ("rgb", "base_rgb"):
        if name in out: out[name] = out[name] * (1 + r * at[0] + r * r * at[1] + r**3 * at[2])
    return out
pipe.model.get_outputs_for_camera = shaded
found["with"] = pipe.get_average_eval_image_metrics()
found = {k: {n: round(float(v), 4) for n, v in r.items() if n in ("psnr", "ssim", "psnr_fitted")} for k, r in found.items()}
Path(sys.argv[3]).write_text(json.dumps({**found, "shading": a.tolist()}))
print(sys.argv[1], found)
