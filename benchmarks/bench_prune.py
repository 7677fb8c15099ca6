"""CPU-seconds of a prune on one thread, and its quality on cameras that it was not given; print CSV rows.

    python benchmarks/bench_prune.py FILE ... --label NAME    # rows of benchmarks/results/prune_cpu.csv

Without files, a scene of 50 random Gaussians. Seconds are of the process, so that other work on the machine counts
little, without loading; a first run compiles, so take the second. PSNR (dB) and SSIM are those of 32 virtual cameras
against the full scene.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from pathlib import Path

import torch

import sundae_ns as sn

COLUMNS = ("label", "field", "gaussians", "kept", "cpu_seconds", "psnr", "ssim")


def random_scene(n: int = 50) -> sn.Scene:
    """Gaussians of random places, shapes and colours."""
    generator = torch.Generator().manual_seed(0)
    means, widths, opacities, colors = (torch.rand(n, size, generator=generator) for size in (3, 3, 1, 3))
    quats = torch.randn(n, 4, generator=generator)
    return sn.Scene.from_arrays(means, 0.02 + 0.1 * widths, quats, 0.2 + 0.7 * opacities[:, 0], colors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="scenes of any program")
    parser.add_argument("--label", default="now")
    parser.add_argument("--keep", type=float, default=0.1)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = csv.writer(sys.stdout, lineterminator="\n")
    rows.writerow(COLUMNS)
    for name, scene in [(file.stem, sn.load(file)) for file in options.files] or [("random", random_scene())]:
        held_out = sn.virtual_cameras(scene, 32, seed=10_000, size=256)
        sn.measure(scene, scene, held_out[:1])
        began = time.process_time()
        small = sn.prune(scene, keep=options.keep)
        seconds = time.process_time() - began
        quality = sn.measure(small, scene, held_out)
        figures = f"{seconds:.1f}", f"{quality.psnr:.3f}", f"{quality.ssim:.4f}"
        rows.writerow([options.label, name, len(scene), len(small), *figures])
        sys.stdout.flush()


if __name__ == "__main__":
    main()
