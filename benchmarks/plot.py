"""Plot quality against bytes and against time of the measured runs: python benchmarks/plot.py [RUNS] [-o FIGURE]."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "benchmarks" / "results" / "runs.csv"
FIGURE = ROOT / "docs" / "figures" / "runs.png"
AXES = (("bytes_total", 1e6, "MB, primitives and head in fp32"), ("ms_frame", 1.0, "ms a frame, head included"))


def ran_beside_others(variant: str) -> bool:
    """Whether runs of this kind shared their GPU: their times say nothing."""
    return variant.endswith("-branch") or variant.startswith("budget-")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="?", default=RUNS)
    parser.add_argument("-o", "--out", type=Path, default=FIGURE)
    options = parser.parse_args()
    with open(options.runs, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["ms_frame"]]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, panels = plt.subplots(len(scenes), 2, figsize=(13, 4.2 * len(scenes)), layout="constrained")
    labels = sorted({(row["method"], row["variant"]) for row in rows})
    colors = {label: plt.get_cmap("tab20")(i % 20) for i, label in enumerate(labels)}
    # One filling a machine: times compare within a filling only.
    newest = rows[-1]["gpu"]
    for scene, line in zip(scenes, panels, strict=True):
        own = [row for row in rows if row["scene"] == scene]
        for (column, unit, title), panel in zip(AXES, line, strict=True):
            for label in labels:
                for here in (True, False):
                    runs = [
                        row
                        for row in own
                        if (row["method"], row["variant"]) == label
                        and (row["gpu"] == newest) == here
                        and not (column == "ms_frame" and ran_beside_others(row["variant"]))
                    ]
                    if not runs:
                        continue
                    panel.scatter(
                        [float(row[column]) / unit for row in runs],
                        [float(row["psnr"]) for row in runs],
                        facecolor=colors[label] if here else "none",
                        edgecolor=colors[label],
                        marker="s" if label[0] == "splatfacto" else "o",
                        s=50 if here else 30,
                        label=" ".join([*label, runs[0]["gpu"].split()[1]]),
                    )
                    if here and label == ("sundae", "default"):
                        for row in runs:
                            place = float(row[column]) / unit, float(row["psnr"])
                            panel.annotate(row["commit"], place, (7, -3), textcoords="offset points", fontsize=7)
            panel.set_xlabel(title)
            panel.set_ylabel("test PSNR, dB")
            panel.set_title(f"{scene}, {own[0]['resolution']} px")
            panel.grid(alpha=0.3)
        handles, names = line[0].get_legend_handles_labels()
        line[1].legend(handles, names, fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, dpi=110)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
