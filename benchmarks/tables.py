"""Print the measured runs as Markdown tables: python benchmarks/tables.py [results/runs.csv].

Branches, whose frames nobody timed, are left out: ``rules_report.py`` shows them.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

RUNS = Path(__file__).parent / "results" / "runs.csv"
COLUMNS = (
    ("method", "method", "{}"),
    ("variant", "variant", "{}"),
    ("keep", "keep_ratio", "{:.0%}"),
    ("primitives", "primitives", "{:,.0f}"),
    ("PSNR", "psnr", "{:.2f}"),
    ("SSIM", "ssim", "{:.4f}"),
    ("PSNR, head off", "psnr_base", "{:.2f}"),
    ("MB", "bytes_total", "{:.1f}"),
    ("ms a frame", "ms_frame", "{:.2f}"),
    ("train s", "train_s", "{:.0f}"),
    ("prune s", "prune_s", "{:.1f}"),
    ("peak primitives", "peak_primitives", "{:,.0f}"),
    ("peak MiB", "peak_vram_mib", "{:,.0f}"),
    ("commit", "commit", "{}"),
)


def cell(row: dict[str, str], column: str, form: str) -> str:
    value = row[column]
    if form == "{}" or not value:
        return value
    number = float(value) / (1e6 if column == "bytes_total" else 1)
    return form.format(number)


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else RUNS
    with open(path, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["ms_frame"]]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == scene]
        print(f"\n**{scene}**, {own[0]['resolution']} px, every 8th image for test\n")
        print("| " + " | ".join([title for title, _, _ in COLUMNS] + ["GPU"]) + " |")
        print("|" + "---|" * (len(COLUMNS) + 1))
        for row in sorted(own, key=lambda r: (r["method"], r["commit"], r["variant"])):
            cells = [cell(row, column, form) for _, column, form in COLUMNS]
            print("| " + " | ".join([*cells, row["gpu"].replace("NVIDIA ", "")]) + " |")


if __name__ == "__main__":
    main()
