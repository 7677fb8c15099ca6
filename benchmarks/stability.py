"""Errors of float32 on the hard cases of the tests, beside float64: images, gradients, and responses of the graph.

    python benchmarks/stability.py -o benchmarks/results/stability.csv

An error is the norm of a difference over that of the exact value: of an image, of the worst gradient, of a response.
The exact one is the reference's in float64, at the coordinates that are given; float32 gets centres as files are
opened. Rasterisers are those of this machine; ``captured`` has our own lists and blending. ``different`` counts points
that have no response in one precision only; there is no error where none has one.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests" / name) for name in ("support", "rasterize", "pruning")]
from bench_graph import response_error  # noqa: E402
from hard_scenes import ALL, CASES, NEAR, scene, with_values  # noqa: E402
from test_backends import CPU, F32, F64, REFERENCE, deviation, make_view, on_gpu, render  # noqa: E402
from test_decision import HARD  # noqa: E402

from harness.rows import Rows  # noqa: E402
from sundae_ns.graph.filters import high_pass  # noqa: E402
from sundae_ns.graph.graph import build_graph  # noqa: E402
from sundae_ns.io.coordinates import recentred  # noqa: E402

COLUMNS = ("case", "what", "device", "error", "gradients", "different")
FAR = 1e7
SCENES = {
    **{name: (make, size) for name, (make, size, *_) in CASES.items()},
    "300 at one point": (lambda: with_values(ALL, means=[0.0, 0.0, 3.0]), 48),
    "survey coordinates of 1e7": (lambda: {**scene(), "means": scene()["means"].double() + FAR}, 48),
    "1 Gaussian": (partial(scene, 1), 48),
    **{f"{n} Gaussians": (partial(scene, n), 48) for n in (2, 3)},
}
FIELDS = {**HARD, "2,000 wide at 1e7": lambda: 1000 * scene(600)["means"] + FAR}


def shifted(viewmat: Tensor, offset: tuple[float, ...] | None) -> Tensor:
    """The extrinsics ``[4, 4]`` of a camera, from which an offset is subtracted as from the scene."""
    moved = viewmat.double()
    moved[:3, 3] += moved[:3, :3] @ torch.tensor(offset or (0.0, 0.0, 0.0), dtype=F64)
    return moved


def rows_of(cuda: bool) -> Iterator[tuple[object, ...]]:
    """A row for each hard scene and rasteriser, then one for each hard set of points."""
    backends = {("reference", "cpu"): REFERENCE, ("cpu", "cpu"): CPU}
    if cuda:
        backends |= {("gsplat", "cuda"): on_gpu("gsplat"), ("captured", "cuda"): on_gpu("recordable")}
    for case, (make, size) in SCENES.items():
        values, camera = make(), make_view(size, size, turned=False)
        if case.startswith("survey"):
            camera["viewmat"] = shifted(camera["viewmat"], 3 * (-FAR,))
        exact = render(values, camera, F64, REFERENCE, near_plane=NEAR)
        means, offset = recentred(values["means"])
        near = {**camera, "viewmat": shifted(camera["viewmat"], offset)}
        for (name, device), backend in backends.items():
            found = render({**values, "means": means}, near, F32, backend, device, near_plane=NEAR)
            errors = {key: deviation(found[key].cpu(), exact[key]) for key in exact if key != "radii"}
            worst = max(error for key, error in errors.items() if key not in ("image", "alpha", "depth"))
            yield case, name, device, f"{errors['image']:.1e}", f"{worst:.1e}", ""
    device = "cuda" if cuda else "cpu"
    for case, make_points in FIELDS.items():
        points = make_points().to(device)
        error, different = response_error(points, high_pass(build_graph(points), points))
        yield case, "response", device, "" if math.isnan(error) else f"{error:.1e}", "", different


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, help="table of results")
    rows = Rows(parser.parse_args().out, COLUMNS, COLUMNS[:3])
    for row in rows_of(torch.cuda.is_available()):
        rows.put(dict(zip(COLUMNS, row, strict=True)))


if __name__ == "__main__":
    main()
