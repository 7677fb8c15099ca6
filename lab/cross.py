"""What other viewers show of a run: base colours and whole image, each rasterised as trained and the other way. cross.py RUN"""
import sys
from pathlib import Path
from statistics import fmean

import torch
from sundae_ns.evaluation import psnr, ssim
from sundae_ns.scenes.opening import open_scene

opened = open_scene(Path(sys.argv[1]))
model = opened.model.eval()
with torch.no_grad():
    for mode in ("antialiased", "classic"):
        model.config.rasterize_mode = mode
        found = {"rgb": [], "base_rgb": []}
        for camera, truth in zip(opened.cameras, opened.truths):
            out = model.get_outputs_for_camera(camera)
            for name, figures in found.items():
                image = out[name]
                figures.append((float(psnr(image, truth.to(image))), float(ssim(image, truth.to(image)))))
        for name, figures in found.items():
            print(f"CROSS {mode} {name} {fmean(p for p, _ in figures):.3f} {fmean(s for _, s in figures):.4f}", flush=True)
