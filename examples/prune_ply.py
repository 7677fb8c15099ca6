"""Make a splat scene of any program smaller, without its photos.

    python examples/prune_ply.py garden.ply small.ply --keep 0.25

The output is .ply, .spz, .sog, .glb, .sundae or .html, by its suffix.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

import sundae_ns as sn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="a file of Gaussians of any program, or a run of ns-train")
    parser.add_argument("out", type=Path, help="file to write")
    parser.add_argument("--keep", type=float, default=0.25, help="share of the Gaussians to keep")
    parser.add_argument("--cameras", type=int, default=128, help="number of virtual cameras")
    options = parser.parse_args()

    scene = sn.load(options.scene, device="cuda" if torch.cuda.is_available() else "cpu")
    cameras = sn.virtual_cameras(scene, options.cameras)
    small = sn.prune(scene, keep=options.keep, cameras=cameras, progress=True)
    sn.save(small, options.out)

    # Other views than those that chose, so that the figure is honest.
    quality = sn.measure(small, scene, sn.virtual_cameras(scene, 16, seed=1))
    size = options.out.stat().st_size / 1e6
    print(f"{small.num_gaussians:,} of {scene.num_gaussians:,} Gaussians, {size:.2f} MB")
    print(f"PSNR {quality.psnr:.2f} dB, SSIM {quality.ssim:.4f} against the whole scene, in 16 virtual views")


if __name__ == "__main__":
    main()
