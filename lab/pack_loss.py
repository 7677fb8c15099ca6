"""What a pack of a run loses by each attribute: all coarse, then one attribute after the other fine. pack_loss.py RUN"""
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import torch

from harness.job import _written
from sundae_ns.scenes.opening import open_scene
from sundae_ns.scenes.packed import contents_of_run
from sundae_ns.storage.packing import PackConfig, fit_scene

opened = open_scene(Path(sys.argv[1]))
contents, usual = contents_of_run(opened.source), PackConfig()
FINE = {"means": {"position_bits": 16, "block": 16}, "scales": {"scale_step": 0.001}, "quats": {"rotation_step": 0.0001}}
FINE |= {"opacities": {"opacity_step": 0.001}, "features_dc": {"color_step": 0.001}, "features_rest": {"harmonics_step": 0.0005}}
with torch.no_grad():
    for name, words in {"usual": {}, **FINE, "all": {k: v for one in FINE.values() for k, v in one.items()}}.items():
        found = _written(opened, Path("/tmp/pack_loss.sundae"), *fit_scene(contents, replace(usual, **words)))
        print(f"PACK {name:14s} {found['bytes']:9,d} bytes {found['psnr']:.3f} dB {found['ssim']:.4f}", flush=True)
