"""Time the neighbour graph of many points and its high-pass response, with their errors; print one JSON line a row.

    python benchmarks/bench_graph.py --points 5000000 --device cuda
    python benchmarks/bench_graph.py --points 1000000 --distributions field uniform --sample 1000

Seconds are medians, ``seconds`` is their sum; the clock waits for the device. ``index_mismatches`` counts rows of
neighbours that differ from those of scipy's k-d tree beyond ties, in a sample of the points. ``response_rel_error`` is
relative to the same in float64; ``isolation_mismatches`` counts points that are isolated in one precision only.
``peak_mib`` is the memory of a build on CUDA beyond that of the points. Lines belong in results/graph.jsonl.

- field: like a trained field. A thousand discs of equal counts, 0.001 to 3 units wide and a fiftieth as thick; one
  point in 50 floats up to 100 units away, one in 100 is a clone of another.
- uniform: in the unit cube.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from sundae_ns.core.timing import median_ms
from sundae_ns.graph.filters import high_pass
from sundae_ns.graph.graph import build_graph

NEIGHBORS = 16
TIE = 1e-12
"""Relative difference up to which two distances in float64 are equal."""
DISCS = 1000


def field_points(n: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Points like the centres of a trained field, float64 ``[n, 3]``."""
    axes = np.linalg.qr(random.normal(size=(DISCS, 3, 3)))[0]
    axes = axes * (10 ** random.uniform(-3, 0.5, (DISCS, 1, 1)) * np.array([[1], [1], [0.02]]))
    disc = random.integers(DISCS, size=n)
    points = random.normal(size=(DISCS, 3))[disc] + np.einsum("ni,nij->nj", random.normal(size=(n, 3)), axes[disc])
    floaters = random.normal(size=(n // 50, 3))
    floaters *= 10 ** random.uniform(0, 2, (n // 50, 1)) / np.linalg.norm(floaters, axis=1, keepdims=True)
    points[: n // 50] = floaters
    order = random.permutation(n)
    points[order[: n // 100]] = points[order[n - n // 100 :]]
    return points


DISTRIBUTIONS: dict[str, Callable[[int, np.random.Generator], NDArray[np.float64]]] = {
    "field": field_points,
    "uniform": lambda n, random: random.uniform(size=(n, 3)),
}


def measure(points: Tensor, device: str, repeats: int, sample: int) -> dict[str, Any]:
    """Seconds, errors and memory of graph and response of points, float32 on the CPU ``[N, 3]``.

    ``repeats`` runs are timed after an untimed one; ``sample`` rows are compared with scipy.
    """
    placed, before = points.to(device), 0
    build = partial(build_graph, placed, num_neighbors=NEIGHBORS)
    builds = median_ms(build, device=device, warmup=1, repeats=repeats) / 1000
    if device == "cuda":
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
    graph = build()
    peak = round((torch.cuda.max_memory_allocated() - before) / 2**20, 1) if device == "cuda" else None
    response = high_pass(graph, placed)
    responses = median_ms(partial(high_pass, graph, placed), device=device, warmup=1, repeats=repeats) / 1000
    error, isolated = response_error(placed, response)
    rows = np.linspace(0, len(points) - 1, min(sample, len(points))).astype(int)
    wrong = wrong_rows(points.double().numpy(), graph.indices.cpu().numpy(), rows)
    return {
        "seconds": rounded(builds + responses),
        "graph_seconds": rounded(builds),
        "response_seconds": rounded(responses),
        "index_mismatches": wrong,
        "response_rel_error": rounded(error, 3),
        "isolation_mismatches": isolated,
        "peak_mib": peak,
    }


def wrong_rows(points: NDArray[np.float64], found: NDArray[np.int64], rows: NDArray[Any]) -> int:
    """The number of wrong ones of the ``rows`` of neighbours ``[N, K]``, by scipy's tree.

    A row is right if its points are distinct, leave out the point itself, and lie at the true distances. It
    may differ from scipy's in points of equal distance.
    """
    true = cKDTree(points).query(points[rows], k=NEIGHBORS + 1, workers=-1)[0][:, 1:]
    near = found[rows]
    together = np.sort(np.concatenate([near, rows[:, None]], axis=1), axis=1)
    repeated = (together[:, 1:] == together[:, :-1]).any(axis=1)
    distances = np.sort(np.linalg.norm(points[near] - points[rows][:, None], axis=2), axis=1)
    return int((repeated | (np.abs(distances - true) > TIE * true).any(axis=1)).sum())


def response_error(placed: Tensor, response: Tensor) -> tuple[float, int]:
    """Relative error of a response ``[N, 3]``, and the number of points that are isolated in one precision only."""
    double = placed.double()
    exact = high_pass(build_graph(double, num_neighbors=NEIGHBORS), double)
    known, found = ~exact.isnan().any(dim=1), ~response.isnan().any(dim=1)
    both = known & found
    error = (response.double() - exact)[both].norm() / exact[both].norm()
    return float(error), int((known != found).sum())


def rounded(value: float, digits: int = 4) -> float:
    return float(f"{value:.{digits}g}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[1_000_000])
    parser.add_argument("--distributions", nargs="+", choices=DISTRIBUTIONS, default=["field", "uniform"])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--repeats", type=int, default=5, help="timed runs; their median counts")
    parser.add_argument("--sample", type=int, default=100_000, help="rows compared with scipy")
    options = parser.parse_args()
    threads = f"{os.cpu_count()} threads for neighbours, {torch.get_num_threads()} for torch"
    name = torch.cuda.get_device_name() if options.device == "cuda" else f"CPU, {threads}"
    for n in options.points:
        for distribution in options.distributions:
            points = torch.from_numpy(DISTRIBUTIONS[distribution](n, np.random.default_rng(0))).float()
            row = {"benchmark": "graph", "points": n, "neighbors": NEIGHBORS, "device": options.device}
            row |= {"device_name": name, "distribution": distribution}
            row |= measure(points, options.device, options.repeats, options.sample)
            print(json.dumps({**row, "torch": torch.__version__}), flush=True)


if __name__ == "__main__":
    main()
