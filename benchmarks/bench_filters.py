"""Error of Chebyshev filters against their order and against time; writes benchmarks/results/filters.json and a plot.

    python benchmarks/bench_filters.py                  # measure and plot
    python benchmarks/bench_filters.py --plot-only      # draw what the file holds

Errors are taken on a small graph, where the exact filter is known: the norm of the difference over the norm of the exact
response. Times are taken on a large one, medians over the repeats; there the exact filter cannot be had at all, so its
time is given for the small one.
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import scipy.sparse as sp
import torch
from rich.progress import track
from torch import Tensor

from sundae_ns.cli.bench.points import draw
from sundae_ns.evaluation import median_ms
from sundae_ns.filters import (
    band_pass_kernel,
    cheby_filter,
    estimate_lmax,
    exact_filter,
    high_pass_kernel,
    low_pass_kernel,
)
from sundae_ns.graphs import build_graph, laplacian

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "filters.json"
FIGURE = ROOT / "docs" / "figures" / "filters.png"
ORDERS = (1, 2, 4, 8, 12, 16, 20, 24, 32, 40, 48, 64)
WIDTHS = (0.05, 0.1, 0.2)
KERNELS = {
    "low-pass": lambda lmax, width: low_pass_kernel(lmax, 0.5, width),
    "band-pass": lambda lmax, width: band_pass_kernel(lmax, 0.25, 0.75, width),
    "high-pass": lambda lmax, width: high_pass_kernel(lmax, 0.5, width),
}


def made(n: int, seed: int) -> tuple[sp.csr_matrix, Tensor]:
    """Normalised Laplacian of a drawn field, and a signal of three channels."""
    points = draw("field", n, seed)
    signal = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return laplacian(build_graph(points), "normalized"), signal


def measure(small: int, large: int, repeats: int, device: str) -> dict[str, Any]:
    L, x = made(small, seed=0)
    lmax = estimate_lmax(L)
    errors = []
    for name in track(KERNELS, description="errors"):
        for width in WIDTHS:
            kernel = KERNELS[name](lmax, width)
            exact = exact_filter(L, x, kernel)
            for order in ORDERS:
                error = (cheby_filter(L, x, kernel, order=order, lmax=lmax) - exact).norm() / exact.norm()
                errors.append({"kernel": name, "width": width, "order": order, "error": float(f"{float(error):.3g}")})
    exact_ms = median_ms(lambda: exact_filter(L, x, low_pass_kernel(lmax)), device="cpu", warmup=0, repeats=1).median_ms

    L, x = made(large, seed=1)
    x = x.to(device)
    lmax_ms = median_ms(lambda: estimate_lmax(L), device="cpu", warmup=1, repeats=repeats).median_ms
    lmax = estimate_lmax(L)
    times = []
    for order in track(ORDERS, description="times"):
        timing = median_ms(
            lambda: cheby_filter(L, x, low_pass_kernel(lmax), order=order, lmax=lmax),  # noqa: B023
            device=device,
            warmup=1,
            repeats=repeats,
        )
        times.append({"order": order, "ms": round(timing.median_ms, 2)})
    return {
        "benchmark": "filters",
        "small": small,
        "large": large,
        "directed_edges": int(L.nnz - large),
        "channels": 3,
        "device": device,
        "device_name": torch.cuda.get_device_name() if device == "cuda" else platform.machine(),
        "threads": torch.get_num_threads(),
        "exact_ms_small": round(exact_ms, 1),
        "estimate_lmax_ms_large": round(lmax_ms, 1),
        "errors": errors,
        "times": times,
        "torch": torch.__version__,
    }


def plot(result: dict[str, Any]) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", sharey=True)
    ms = {row["order"]: row["ms"] for row in result["times"]}
    colors = dict(zip(KERNELS, ("tab:blue", "tab:green", "tab:red"), strict=True))
    styles = dict(zip(WIDTHS, ("-", "--", ":"), strict=True))
    for name in KERNELS:
        for width in WIDTHS:
            rows = [row for row in result["errors"] if (row["kernel"], row["width"]) == (name, width)]
            for panel, x in ((left, [row["order"] for row in rows]), (right, [ms[row["order"]] for row in rows])):
                panel.plot(x, [row["error"] for row in rows], color=colors[name], linestyle=styles[width], marker=".")
    left.set_xlabel("order")
    left.set_ylabel("relative error")
    left.set_yscale("log")
    right.set_xlabel(f"ms on {result['large']:,} nodes, {result['channels']} channels, {result['device']}")
    for panel in (left, right):
        panel.grid(alpha=0.3)
    handles = [plt.Line2D([], [], color=color, label=name) for name, color in colors.items()]
    handles += [plt.Line2D([], [], color="black", linestyle=s, label=f"width {w} lmax") for w, s in styles.items()]
    left.legend(handles=handles, fontsize=8)
    FIGURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(FIGURE, dpi=110)
    print(f"wrote {FIGURE}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", type=int, default=2000, help="nodes of the graph for the errors")
    parser.add_argument("--large", type=int, default=200_000, help="nodes of the graph for the times")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where the times are taken")
    parser.add_argument("--plot-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.plot_only:
        result = measure(arguments.small, arguments.large, arguments.repeats, arguments.device)
        RESULTS.write_text(json.dumps(result, indent=1) + "\n")
        print(f"wrote {RESULTS}")
    plot(json.loads(RESULTS.read_text()))


if __name__ == "__main__":
    main()
