"""Draw the plots of docs/results.md from benchmarks/results, into docs/figures.

python benchmarks/plot.py            # error.png, asked.png
python benchmarks/plot.py asked      # one of them
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
from tables import MB, defaults, lines_of, mean, stock_in

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
STYLES = {
    "splatfacto": ("s", "gray"),
    "splatfacto, .sog": ("^", "gray"),
    "sundae": ("o", "tab:red"),
    "sundae, fine-tuned": ("P", "tab:red"),
    "sundae-fast": ("D", "tab:blue"),
}
"""Markers and colours of methods."""
RULES = {"detail-merge": "default", "contribution-top": "contribution", "random": "random", "paper": "paper's band"}
"""Rules of the prune that are shown, and their names."""
CHANGED = "default, exposures changed"
LIGHT = {"default": "photos as they are", CHANGED: "compensation auto", f"{CHANGED}, compensation off": "off"}


def logarithmic(panel: Any, ticks: list[float]) -> None:
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.set_xticks(ticks)


def plot_error() -> Any:
    """Quality against time and size, in decibels over stock, and the error of the graph's response against time."""
    runs = lines_of("training_time.jsonl")
    marks = [(0, row["scene"], row["arm"], row["train_s"], row["psnr"]) for row in runs]
    marks += [(2, row["scene"], row["arm"], row["ms_frame"], row["psnr"]) for row in runs if "ms_frame" in row]
    for capture, files in stock_in(dict).items():
        for kind, method in ((".sundae", "splatfacto"), (".sog theirs", "splatfacto, .sog")):
            if kind in files:
                marks.append((1, capture, method, files[kind]["bytes"] / MB, files[kind]["psnr"]))
    for capture, rows in defaults().items():
        for kind, method in (("packed", "sundae"), ("tuned", "sundae, fine-tuned")):
            marks.append((1, capture, method, mean(rows, f"{kind}_bytes") / MB, mean(rows, f"{kind}_psnr")))
    stock = {(number, capture): psnr for number, capture, method, _, psnr in marks if method == "splatfacto"}
    figure, ((seconds, sizes), (frames, graph)) = plt.subplots(2, 2, figsize=(10, 7.5), layout="constrained")
    panels = (seconds, sizes, frames)
    for (number, capture), zero in stock.items():
        panel, color = panels[number], f"C{sorted({name for _, name in stock}).index(capture)}"
        spots = sorted((x, psnr - zero, method) for *where, method, x, psnr in marks if where == [number, capture])
        panel.plot([x for x, *_ in spots], [y for _, y, _ in spots], color=color, linewidth=0.7, zorder=1)
        for x, y, method in spots:
            panel.plot(x, y, STYLES[method][0], color=STYLES[method][1], label=method)
        best = max(spots, key=lambda spot: spot[1])
        panel.annotate(capture, best[:2], (6, 5), textcoords="offset points", fontsize=8, color=color)
    for panel, label in zip(panels, ("seconds of training", "MB, packed", "milliseconds a frame")):
        panel.set(xlabel=label, ylabel="test PSNR over splatfacto's, dB", xmargin=0.16, ymargin=0.1)
    logarithmic(seconds, [30, 100, 300])
    logarithmic(sizes, [0.3, 1, 3, 10])
    frames.set_xlim(0)
    for row in (row for row in lines_of("graph.jsonl") if row["distribution"] == "field"):
        label, color = ("H100, H200", "tab:green") if row["device"] == "cuda" else ("CPU", "tab:orange")
        spot = row["seconds"], row["response_rel_error"]
        graph.plot(*spot, "v", color=color, label=f"graph and response, {label}")
        graph.annotate(f"{row['points'] / 1e6:g}M", spot, (4, 5), textcoords="offset points", fontsize=7)
    graph.set(xlabel="seconds for millions of points", ylabel="relative error", yscale="log", ylim=(1e-8, 1e-6))
    graph.margins(x=0.1)
    logarithmic(graph, [0.01, 0.1, 1])
    labels = {str(line.get_label()): line for panel in figure.axes for line in panel.get_legend_handles_labels()[0]}
    figure.legend(labels.values(), labels, fontsize=9, loc="outside lower center", ncols=4)
    return figure


def lines(panel: Any, name: str, series: Callable[[dict[str, Any]], Any], x: str, y: str) -> None:
    """Means of a file's column ``y`` over its ``x``, a line for each ``series`` of rows; None leaves a row out."""
    groups: dict[str, dict[Any, list[dict[str, Any]]]] = {}
    for row in lines_of(name):
        if label := series(row):
            at = row[x] if x == "capture" else float(row[x])
            groups.setdefault(label, {}).setdefault(at, []).append(row)
    for marker, (label, rows) in zip("osD^vPX*hd" * 2, groups.items()):
        line = marker if x == "capture" else f"{marker}-"
        panel.plot(sorted(rows), [mean(rows[at], y) for at in sorted(rows)], line, label=label, fillstyle="none")
    panel.legend(fontsize=7)


def few_photos(row: dict[str, Any]) -> str | None:
    complete = row["views"] in ("12", "16", "24")
    return row["arm"] if complete and row["arm"] in ("default", "5%", "before the prune", "splatfacto") else None


def plot_asked() -> Any:
    """Asked sizes, levels of detail, cleaning, few photos, changed exposures and rules of pruning, a panel each."""
    figure, ((sizes, levels, cleaning), (few, light, rules)) = plt.subplots(2, 3, figsize=(11, 7), layout="constrained")
    lines(sizes, "sizes_asked.csv", lambda row: row["source"] == "trained" and row["capture"], "got_mb", "psnr")
    lines(levels, "levels.csv", lambda row: row["tool"], "share", "psnr_to_field")
    lines(few, "few_counts.csv", few_photos, "views", "psnr")
    lines(light, "few_counts.csv", lambda row: row["views"] == "40" and LIGHT.get(row["arm"]), "capture", "psnr")
    for marker, strength in zip("os", ("0.25", "0.5")):
        fields = [row for row in lines_of("cleaning.csv") if (row["kind"], row["strength"]) == ("all", strength)]
        spots = [(float(row["psnr_lost"]), int(row["removed"])) for row in fields]
        cleaning.plot(*zip(*spots), marker, label=strength, fillstyle="none")
    cleaning.legend(fontsize=7)
    sizes.set(title="asked sizes, trained", xlabel="MB got", ylabel="test PSNR, dB", xlim=(0, 7))
    levels.set(title="levels, mean of fields", xlabel="share of Gaussians", ylabel="PSNR to the field, dB")
    cleaning.set(title="cleaning by strength", xlabel="PSNR lost, dB", ylabel="floaters found of 400", ylim=(360, 401))
    few.set(title="few photos, mean of seven captures", xlabel="training views", ylabel="test PSNR, dB")
    light.set(title="40 views, exposures changed by 15%", ylabel="test PSNR, dB", ymargin=0.2)
    light.tick_params(axis="x", labelrotation=30)
    lines(rules, "rules.csv", lambda row: row["scene"] == "bonsai" and RULES.get(row["rule"]), "keep", "psnr")
    rules.set(title="rules, bonsai, no head", xlabel="share of Gaussians", ylabel="test PSNR, dB")
    return figure


PLOTS: dict[str, Callable[[], Any]] = {"error": plot_error, "asked": plot_asked}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plot", nargs="?", choices=PLOTS, help="by default all")
    options = parser.parse_args()
    for name in [options.plot] if options.plot else PLOTS:
        figure = PLOTS[name]()
        for panel in figure.axes:
            panel.grid(alpha=0.3)
        figure.savefig(FIGURES / f"{name}.png", dpi=110)
        print(f"wrote {name}.png")


if __name__ == "__main__":
    main()
