"""Tables of the branches of ``rules.py`` in Markdown, and their figures: python benchmarks/rules_report.py [rules.jsonl].

A cell is the mean over seeds, with half the range between them where there are several. Columns are keep ratios; sweeps get a
figure of their own.
"""

from __future__ import annotations

import argparse
import re
from collections import defaultdict
from pathlib import Path
from statistics import mean
from typing import Any

import matplotlib
import rules

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.lines import Line2D
from tables import with_spread

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
SWEPT = re.compile(r"^(?P<rule>.+) (?P<what>gamma|reach|k) x?(?P<value>[\d.]+)$")
TITLES = {"gamma": "gamma: share of the high end", "reach": "reach of edges / robust rule's", "k": "most neighbours"}
Groups = dict[tuple[str, int], list[dict[str, Any]]]


def cell(lines: list[dict[str, Any]], column: str) -> str:
    values = [line[column] for line in lines if line[column] is not None]
    return with_spread(values) if values else ""


def tables(groups: Groups) -> None:
    for (scene, steps), lines in groups.items():
        keeps = sorted({line["keep"] for line in lines})
        by_rule: dict[str, dict[float, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
        for line in lines:
            by_rule[line["rule"]][line["keep"]].append(line)
        print(f"\n**{scene}**, {steps:,} steps after the prune\n")
        print("| rule | " + " | ".join(f"{k:.0%}: pruned | tuned" for k in keeps) + " |")
        print("|---|" + "---|---|" * len(keeps))
        # By how far a rule is above the mean of all at a budget, over the budgets that it was tried at.
        level = {k: mean(line["psnr"] for line in lines if line["keep"] == k) for k in keeps}
        for rule in sorted(by_rule, key=lambda r: -mean(mean(_of(by_rule[r][k])) - level[k] for k in by_rule[r])):
            cells = [cell(by_rule[rule][k], c) for k in keeps for c in ("psnr_pruned", "psnr")]
            print(f"| {rule} | " + " | ".join(cells) + " |")


def dots(groups: Groups, path: Path) -> None:
    """One panel a capture, budget and length: PSNR of every rule, distance to random draws, a dot a seed."""
    columns = max(len({line["keep"] for line in lines}) for lines in groups.values())
    most = [
        max(len({x["rule"] for x in lines if x["keep"] == line["keep"]}) for line in lines) for lines in groups.values()
    ]
    heights = [0.9 + 0.19 * count for count in most]
    figure, axes = plt.subplots(
        len(groups),
        columns,
        figsize=(4.6 * columns, sum(heights)),
        height_ratios=heights,
        layout="constrained",
        squeeze=False,
    )
    for row, (group, everything) in enumerate(groups.items()):
        keeps = sorted({line["keep"] for line in everything})
        for axis in axes[row][len(keeps) :]:
            axis.set_visible(False)
        for axis, keep in zip(axes[row], keeps, strict=False):
            lines = [line for line in everything if line["keep"] == keep]
            names = sorted({line["rule"] for line in lines}, key=lambda n: mean(_of(lines, n)))
            start = mean(_of(lines, "random")) if "random" in names else None
            if start is not None:
                axis.axvline(start, color="0.8", linewidth=1)
            for place, name in enumerate(names):
                values = _of(lines, name)
                color = "0.5" if name in (*rules.CONTROLS, "mcmc") else "tab:blue"
                if start is not None:
                    axis.plot([start, mean(values)], [place] * 2, color=color, linewidth=2, alpha=0.5)
                axis.plot(values, [place] * len(values), "o", color=color, markersize=5)
            axis.set_yticks(range(len(names)), names, fontsize=7)
            axis.set_ylim(-0.7, len(names) - 0.3)
            axis.set_title(f"{group[0]}, {keep:.0%}, {group[1]:,} steps", fontsize=9)
            axis.set_xlabel("test PSNR, dB", fontsize=8)
            axis.tick_params(axis="x", labelsize=7)
    _save(figure, path)


def _of(lines: list[dict[str, Any]], rule: str | None = None) -> list[float]:
    return [line["psnr"] for line in lines if rule in (None, line["rule"])]


def sweeps(lines: list[dict[str, Any]], path: Path) -> None:
    curves: dict[str, dict[str, dict[float, list[float]]]] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for line in lines:
        found = SWEPT.match(line["rule"])
        if found:
            label = f"{line['scene']}, {found['rule']}, {line['keep']:.0%}, {line['steps']:,} steps"
            curves[found["what"]][label][float(found["value"])].append(line["psnr"])
    if not curves:
        return
    names = sorted({label for labels in curves.values() for label in labels})
    colors = {name: plt.get_cmap("tab10")(i) for i, name in enumerate(names)}
    figure, axes = plt.subplots(1, len(curves), figsize=(4.6 * len(curves), 4.3), layout="constrained", squeeze=False)
    for axis, (what, labels) in zip(axes[0], curves.items(), strict=True):
        for label, points in sorted(labels.items()):
            values = sorted(points)
            axis.plot(values, [mean(points[v]) for v in values], ".-", color=colors[label])
        if what != "gamma":
            axis.set_xscale("log", base=2)
        axis.set_xlabel(TITLES[what])
        axis.set_ylabel("test PSNR, dB")
        axis.grid(alpha=0.3)
    lines_of = [Line2D([], [], color=colors[name], marker=".", label=name) for name in names]
    figure.legend(handles=lines_of, loc="outside lower center", ncols=3, fontsize=8)
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    print(f"wrote {path.name}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path, nargs="?", default=rules.RESULTS)
    parser.add_argument("--figures", type=Path, default=FIGURES)
    options = parser.parse_args()
    lines = rules.finished(options.results)
    groups: Groups = defaultdict(list)
    for line in lines:
        if not SWEPT.match(line["rule"]):
            groups[line["scene"], line["steps"]].append(line)
    tables(groups)
    if groups:
        dots(
            {group: own for group, own in groups.items() if group[1]} or groups,
            options.figures / f"{options.results.stem}.png",
        )
    sweeps(lines, options.figures / f"{options.results.stem}-sweeps.png")


if __name__ == "__main__":
    main()
