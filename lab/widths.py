"""Layouts of a run's positions: the share of near Gaussians that are coarse in each, and how narrow Gaussians are: widths.py RUN"""

import sys
from pathlib import Path

import numpy as np

from sundae_ns.io.coordinates import scene_order
from sundae_ns.io.pack import codecs
from sundae_ns.io.pack.config import PackConfig
from sundae_ns.io.pack.packed_scene import fit_scene, write_fitted
from sundae_ns.plugin.finished_runs import load_run
from sundae_ns.scene.packing import contents_of

contents = contents_of(load_run(Path(sys.argv[1])))
values = {name: codecs.as_matrix(value) for name, value in contents.gaussians.items()}
widths, logits = np.exp(values["scales"].max(axis=1)), values["opacities"][:, 0]
order, near = scene_order(values["means"])
print(sys.argv[1], len(order), "near", round(near / len(order), 4))
for low, high in ((-99, -5.537), (-5.537, -3), (-3, 99)):
    chosen = (logits >= low) & (logits < high)
    if chosen.any():
        print(f"logits {low} to {high}: {chosen.mean():.4f}, widths", np.quantile(widths[chosen], (0, 0.001, 0.01, 0.1, 0.5)))
for size, bits in ((1024, 13), (1024, 14), (1024, 16), (256, 13), (256, 16), (64, 13), (64, 16), (16, 13), (16, 16)):
    blocks, within = codecs.quantize_positions(values["means"][order], bits, size)
    cells = ((blocks.high.astype(np.float64) - blocks.low) / 2**bits).max(axis=1)[np.arange(len(order)) // size]
    coarse = (cells > 3 * widths[order[within]])[:near]
    print(size, bits, f"coarse {coarse.mean():.5f}, of those seen {coarse[logits[order[within]][:near] > -5.537].mean():.5f}")
scene, fitted = fit_scene(contents, PackConfig())
print(fitted.config.block, fitted.config.position_bits, write_fitted(Path("/tmp/widths.sundae"), scene, fitted).summary())
