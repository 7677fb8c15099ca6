"""Errors of float32 on the hard cases of the tests, beside float64: images, gradients, and responses of the graph.

    python lab/stability.py -o benchmarks/results/stability.csv

An error is the norm of a difference over that of the exact value: of an image, of the worst gradient, of a response.
The exact one is the reference's in float64; rasterisers are those of this machine. ``different`` counts points that
have no response in one precision only.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / name) for name in ("benchmarks", "tests/support", "tests/rasterize", "tests/pruning")]
from bench_graph import response_error  # noqa: E402
from hard_scenes import CASES, NEAR, scene  # noqa: E402
from test_backends import CPU, F32, F64, REFERENCE, deviation, make_view, render  # noqa: E402
from test_decision import HARD  # noqa: E402

from harness.rows import Rows  # noqa: E402
from sundae_ns.graph.filters import high_pass  # noqa: E402
from sundae_ns.graph.graph import build_graph  # noqa: E402
from sundae_ns.rasterize.interface import select_backend  # noqa: E402

COLUMNS = ("case", "what", "device", "error", "gradients", "different")
FIELDS = {**HARD, "600 points at 1e7": lambda: torch.rand(600, 3) + 1e7}
SCENES = {**CASES, **{f"{n} Gaussians": (partial(scene, n), 48) for n in (1, 2, 3)}}


def rows_of(device: str) -> Iterator[tuple[object, ...]]:
    """A row for each hard scene and rasteriser, then one for each hard set of points."""
    backends = [(REFERENCE, "cpu"), (CPU, "cpu")]
    backends += [(select_backend("gsplat", "cuda"), "cuda")] if device == "cuda" else []
    for name, (make, size, *_) in SCENES.items():
        values, camera = make(), make_view(size, size, turned=False)
        exact = render(values, camera, F64, REFERENCE, near_plane=NEAR)
        for backend, where in backends:
            found = render(values, camera, F32, backend, where, near_plane=NEAR)
            errors = {key: deviation(found[key].cpu(), exact[key]) for key in exact if key != "radii"}
            worst = max(error for key, error in errors.items() if key not in ("image", "alpha", "depth"))
            yield name, backend.name, where, f"{errors['image']:.1e}", f"{worst:.1e}", ""
    for name, make in FIELDS.items():
        points = make().to(device)
        error, different = response_error(points, high_pass(build_graph(points), points))
        yield name, "response", device, f"{error:.1e}", "", different


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path)
    rows = Rows(parser.parse_args().out, COLUMNS, COLUMNS[:3])
    for row in rows_of("cuda" if torch.cuda.is_available() else "cpu"):
        rows.put(dict(zip(COLUMNS, row, strict=True)))


if __name__ == "__main__":
    main()
