"""Plot quality against bytes and against time of the measured runs: python benchmarks/plot.py."""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "benchmarks" / "results" / "runs.csv"
FIGURE = ROOT / "docs" / "figures" / "runs.png"
AXES = (("bytes_total", 1e6, "MB, primitives and head in fp32"), ("ms_frame", 1.0, "ms a frame, head included"))


def main() -> None:
    with open(RUNS, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["ms_frame"]]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, panels = plt.subplots(len(scenes), 2, figsize=(11, 4.2 * len(scenes)), layout="constrained")
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
                        # Branches ran side by side: their times say nothing.
                        and not (column == "ms_frame" and row["variant"].endswith("-branch"))
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
        line[0].legend(fontsize=7, loc="center right")
    FIGURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(FIGURE, dpi=110)
    print(f"wrote {FIGURE}")


if __name__ == "__main__":
    main()
