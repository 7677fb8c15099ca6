"""Plot what ``multi_gpu.py`` has recorded: python benchmarks/multi_gpu_plot.py [multi_gpu.jsonl] [-o FIGURE].

Left: test PSNR against seconds of training, a curve for each number of GPUs. Middle and right: pictures a second and the
memory of the GPU that takes most, both over one GPU, by size of the field.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).parents[1]
BARS = {"pictures a second": {2: 1.7, 4: 3.0}, "memory of a GPU": {2: 0.6}}
"""What was asked for, over one GPU, by number of GPUs."""


def latest(lines: list[dict[str, Any]]) -> dict[str, dict[int, dict[str, Any]]]:
    """The longest run of each kind of field and number of GPUs, the later one of equals; by kind, then number."""
    runs: dict[str, dict[int, dict[str, Any]]] = defaultdict(dict)
    for line in lines:
        tiled = line["variant"].startswith("multi-gpu-tiled")
        kind = f"{line['scene']}, {'tiled to ' + format(line['primitives'], ',') if tiled else 'a whole run'}"
        before = runs[kind].get(line["ranks"])
        if before is None or line["pictures"] >= before["pictures"]:
            runs[kind][line["ranks"]] = line
    return runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="?", default=ROOT / "benchmarks/results/multi_gpu.jsonl")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "docs/figures/multi_gpu.png")
    options = parser.parse_args()
    runs = latest([json.loads(line) for line in options.results.read_text().splitlines()])
    figure, (curves, *ratios) = plt.subplots(1, 3, figsize=(13, 3.9), layout="constrained")
    for kind, by_ranks in runs.items():
        for ranks, line in sorted(by_ranks.items()):
            points = sorted((int(n) / line["pictures_per_s"], psnr) for n, psnr in line["psnr_after_pictures"].items())
            if len(points) > 1:
                label = f"{line['scene']}, {ranks} GPU{'s' * (ranks > 1)}"
                curves.plot(*zip(*points, strict=True), ".-", label=label)
        counts = sorted(by_ranks)
        if 1 not in counts:
            continue
        one = by_ranks[1]
        shares = (
            [by_ranks[n]["pictures_per_s"] / one["pictures_per_s"] for n in counts],
            [max(by_ranks[n]["peak_mib"]) / max(one["peak_mib"]) for n in counts],
        )
        for axis, values in zip(ratios, shares, strict=True):
            axis.plot(counts, values, "o-", label=kind)
    curves.set_xlabel("seconds of training, evaluation left out")
    curves.set_ylabel("test PSNR, dB")
    for axis, (title, bars) in zip(ratios, BARS.items(), strict=True):
        axis.plot(list(bars), list(bars.values()), "k_", markersize=22, label="asked for")
        axis.set_xticks([1, 2, 4])
        axis.set_ylim(bottom=0)
        axis.set_xlabel("GPUs")
        axis.set_ylabel(f"{title}, over one GPU")
    for axis in (curves, *ratios):
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(options.out, dpi=110)
    print(f"wrote {options.out.name}")


if __name__ == "__main__":
    main()
