"""Print the branches as a Markdown table, scenes side by side: python benchmarks/branch_table.py [STEPS] [--results FILE].

A cell is the mean over seeds, with half the range between them where there are several. Gains are over the branches without a
head from the same pruned field.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import defaultdict
from pathlib import Path
from statistics import mean
from typing import Any

from tables import with_spread

BRANCHES = Path(__file__).parent / "results" / "branches.jsonl"
AGAIN = re.compile(r"-(15000|seed-\d+)$")
"""Ends of names that tell runs of one kind apart."""

OTHERS = {"ssim": 4, "psnr_base": 2, "train_psnr": 2}
"""Columns after PSNR, and their decimals."""

Lines = list[dict[str, Any]]


def is_plain(line: dict[str, Any]) -> bool:
    """Whether it has no head, and is trained as the others are."""
    changed = any(value and (name, value) != ("rates", 1.0) for name, value in line["experiments"].items())
    return "head.mode off" in line["command"] and not changed


def gained(line: dict[str, Any], lines: Lines) -> float | None:
    """PSNR over that without a head, of the same field; None where there is no such branch."""
    of_field = [x for x in lines if (x["scene"], x["primitives"]) == (line["scene"], line["primitives"])]
    plain = [x["psnr"] for x in of_field if is_plain(x)]
    return line["psnr"] - mean(plain) if plain else None


def cells(runs: Lines, lines: Lines) -> list[str]:
    if not runs:
        return [""] * 4
    gains = [gain for run in runs if (gain := gained(run, lines)) is not None]
    # Adding zero takes the minus from a rounded -0.
    over_plain = f" ({round(mean(gains), 2) + 0.0:+.2f})" if gains else ""
    others = [f"{mean(run[key] for run in runs):.{digits}f}" for key, digits in OTHERS.items()]
    return [with_spread([run["psnr"] for run in runs]) + over_plain, *others]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("steps", type=int, nargs="?", default=4000, help="length of the fine-tunes to show")
    parser.add_argument("--commits", nargs="+", help="only branches that these made; by default all")
    parser.add_argument("--results", type=Path, default=BRANCHES)
    options = parser.parse_args()
    steps = options.steps
    lines = [json.loads(line) for line in options.results.read_text().splitlines()]
    if steps not in (known := sorted({line["steps"] for line in lines})):
        parser.error(f"there are no branches of {steps} steps; give one of {', '.join(map(str, known))}")
    lines = [line for line in lines if line["steps"] == steps]
    if options.commits:
        if unknown := sorted(set(options.commits) - {line["commit"] for line in lines}):
            parser.error(f"there are no branches of {steps} steps of {', '.join(unknown)}; leave that out")
        lines = [line for line in lines if line["commit"] in options.commits]
    scenes = list(dict.fromkeys(line["scene"] for line in lines))
    by_name: dict[str, dict[str, Lines]] = defaultdict(lambda: defaultdict(list))
    for line in lines:
        by_name[AGAIN.sub("", line["name"])][line["scene"]].append(line)
    print("| variant | " + " | ".join(f"{s}: PSNR (gain) | SSIM | head off | training views" for s in scenes) + " |")
    print("|---|" + "---|" * (4 * len(scenes)))

    def order(name: str) -> list[float]:
        return [-mean(run["psnr"] for run in by_name[name][s]) if by_name[name][s] else 0.0 for s in scenes]

    for name in sorted(by_name, key=order):
        print(f"| {name} | " + " | ".join(cell for s in scenes for cell in cells(by_name[name][s], lines)) + " |")


if __name__ == "__main__":
    main()
