"""Draw the plots of docs/results.md from benchmarks/results, into docs/figures.

python benchmarks/plot.py            # curve.png, rules.png, time.png
python benchmarks/plot.py curve      # one of them
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import NullFormatter
from tables import MB, lines_of

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
PRUNED = ("bonsai", "fox")
"""Captures whose pruning rules are compared."""
ARMS = {"splatfacto": "gray", "sundae": "tab:red", "sundae-fast": "tab:blue"}
"""Methods whose trainings are timed, and their colours."""
KEPT_RULES = {
    "detail-merge": "detail, merged (default)",
    "detail": "detail",
    "response-contribution": "response x contribution",
    "contribution": "contribution, sampled",
    "contribution-top": "highest contribution",
    "random": "random",
    "paper": "paper's band",
}
"""Rules of the plot, by the names that readers see."""


def logarithmic(panel: Any, ticks: list[float]) -> None:
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.set_xticks(ticks)
    panel.grid(alpha=0.3)


def plot_curve() -> Any:
    """PSNR and SSIM of packed scenes by size: fixed shares, what the default has chosen, and its fine-tuned pack."""
    rows = [row for row in lines_of("curve.csv") if row["seed"] == "42"]
    packs = [row for row in lines_of("formats.csv") if row["format"] == ".sundae"]
    stock = {row["capture"]: row for row in packs if row["method"] == "splatfacto"}
    captures = list(dict.fromkeys(row["capture"] for row in rows))
    size = (3 * len(captures), 5.5)
    figure, panels = plt.subplots(2, len(captures), figsize=size, layout="constrained", sharex="col")
    for column, capture in zip(panels.T, captures, strict=True):
        own = [row for row in rows if row["capture"] == capture]
        fixed = [row for row in own if row["chosen"] == "no" and row["method"] == "sundae"]
        fixed.sort(key=lambda row: float(row["share"]))
        for panel, metric in zip(column, ("psnr", "ssim"), strict=True):
            sizes = [int(row["packed_bytes"]) / MB for row in fixed]
            values = [float(row[f"packed_{metric}"]) for row in fixed]
            panel.plot(sizes, values, "-", color="tab:blue", label="fixed shares")
            for row, x, y in zip(fixed, sizes, values, strict=True):
                panel.plot(x, y, "o", color="tab:blue", markerfacecolor="tab:blue" if row["head"] == "yes" else "white")
                share = f"{100 * float(row['share']):g}%"
                panel.annotate(share, (x, y), (4, -10), textcoords="offset points", fontsize=7)
            for row in own:
                if row["chosen"] == "yes":
                    place = int(row["packed_bytes"]) / MB, float(row[f"packed_{metric}"])
                    shown = "tab:red" if row["head"] == "yes" else "white"
                    panel.plot(*place, "D", color="tab:red", markerfacecolor=shown, markersize=8, label="sundae")
                    if row["tuned_bytes"]:
                        place = int(row["tuned_bytes"]) / MB, float(row[f"tuned_{metric}"])
                        panel.plot(*place, "P", color="tab:red", markersize=8, label="sundae, fine-tuned")
            if capture in stock:
                place = int(stock[capture]["bytes"]) / MB, float(stock[capture][metric])
                panel.plot(*place, "s", color="gray", label="splatfacto")
            logarithmic(panel, [0.3, 1, 3, 10])
            panel.margins(y=0.12)
        column[0].set_title(capture, fontsize=10)
        column[1].set_xlabel("MB, packed")
    panels[0, 0].set_ylabel("test PSNR, dB")
    panels[1, 0].set_ylabel("test SSIM")
    seen = {name: line for panel in panels.flat for line, name in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(seen.values(), seen, fontsize=9, loc="outside lower center", ncols=3)
    return figure


def plot_rules() -> Any:
    """PSNR of pruning rules against the share they keep, over random Gaussians, a panel for each capture."""
    figure, panels = plt.subplots(1, len(PRUNED), figsize=(5.5 * len(PRUNED), 4), layout="constrained")
    for panel, scene in zip(panels, PRUNED, strict=True):
        lines = [line for line in lines_of("rules.csv") if line["scene"] == scene]
        psnr = {(line["rule"], float(line["keep"])): float(line["psnr"]) for line in lines}
        keeps = sorted({keep for _, keep in psnr})
        for rule, name in KEPT_RULES.items():
            gains = [psnr[rule, keep] - psnr["random", keep] for keep in keeps]
            width = 2.5 if rule == "detail-merge" else 1.2
            panel.plot([f"{keep:.0%}" for keep in keeps], gains, "o-", label=name, linewidth=width)
        panel.set_title(f"{scene}, 15,000 steps after the prune, no head", fontsize=9)
        panel.set_xlabel("Gaussians kept")
        panel.set_ylabel("test PSNR over random Gaussians, dB")
        panel.grid(alpha=0.3)
    figure.legend(*panels[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4)
    return figure


def plot_time() -> Any:
    """PSNR of the test views against the seconds of a training, a panel for each capture that has curves, if any."""
    rows = [row for row in lines_of("training_time.jsonl") if row.get("curve")]
    if not rows:
        return None
    captures = list(dict.fromkeys(row["scene"] for row in rows))
    size = (3.2 * len(captures), 2.9)
    figure, (panels,) = plt.subplots(1, len(captures), figsize=size, layout="constrained", squeeze=False)
    for panel, capture in zip(panels, captures, strict=True):
        for row in (row for row in rows if row["scene"] == capture):
            points = [*(point[:2] for point in row["curve"]), [row["train_s"], row["psnr"]]]
            panel.plot(*zip(*points, strict=True), color=ARMS[row["arm"]], label=row["arm"])
            panel.plot(*points[-1], "o", color=ARMS[row["arm"]])
        panel.set_title(capture, fontsize=10)
        logarithmic(panel, [3, 10, 30, 100, 300])
        panel.set_xlabel("seconds of training")
    panels[0].set_ylabel("test PSNR, dB")
    figure.legend(*panels[0].get_legend_handles_labels(), fontsize=9, loc="outside lower center", ncols=3)
    return figure


PLOTS: dict[str, Callable[[], Any]] = {"curve": plot_curve, "rules": plot_rules, "time": plot_time}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plot", nargs="?", choices=PLOTS, help="by default all")
    parser.add_argument("-o", "--out", type=Path, default=FIGURES, help="folder")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in [options.plot] if options.plot else PLOTS:
        figure = PLOTS[name]()
        if figure is not None:
            figure.savefig(options.out / f"{name}.png", dpi=110)
        print(f"{name}.png has no rows yet" if figure is None else f"wrote {name}.png")


if __name__ == "__main__":
    main()
