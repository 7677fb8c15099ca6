"""Plot how the quality of a scene falls with its number of Gaussians, before any training.

    python examples/plot_curve.py garden.ply curve.png

Each share is pruned from the whole scene and compared with it, in views that the prune did not use.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import torch

import sundae_ns as sn

matplotlib.use("agg")
import matplotlib.pyplot as plt

SHARES = (0.05, 0.1, 0.2, 0.4, 0.7)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="a file of Gaussians of any program, or a run of ns-train")
    parser.add_argument("out", type=Path, help="image to write")
    parser.add_argument("--cameras", type=int, default=64, help="number of virtual cameras")
    options = parser.parse_args()

    scene = sn.load(options.scene, device="cuda" if torch.cuda.is_available() else "cpu")
    cameras, others = sn.virtual_cameras(scene, options.cameras), sn.virtual_cameras(scene, 16, seed=1)
    rules = {"merged": sn.PruneRule(), "not merged": sn.PruneRule(redistribution="none")}
    figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
    for name, rule in rules.items():
        small = [sn.prune(scene, keep=share, cameras=cameras, rule=rule) for share in SHARES]
        found = [sn.measure(each, scene, others, head=False) for each in small]
        for each, quality in zip(small, found, strict=True):
            print(f"{name}: {each.num_gaussians:,} Gaussians, {quality.psnr:.2f} dB, SSIM {quality.ssim:.4f}")
        axes.plot([each.num_gaussians for each in small], [quality.psnr for quality in found], "o-", label=name)
    axes.set(xscale="log", xlabel="Gaussians", ylabel="PSNR against the whole scene, dB")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(options.out, dpi=150)
    print(options.out)


if __name__ == "__main__":
    main()
