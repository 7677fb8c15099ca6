"""Rewrite the tables of README.md and docs/*.md from benchmarks/results.

    python benchmarks/tables.py            # rewrite every table between its markers
    python benchmarks/tables.py quality    # print one table

A page holds the markers ``<!-- table: NAME -->`` and ``<!-- end of table -->``; the lines between them are made here.
``tests/test_benchmarks.py`` checks that every page is current.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sundae_ns.evaluation.document import number, table

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
MARKED = re.compile(r"(<!-- table: (?P<name>[\w-]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)
MB = 1e6

METHODS = {
    "splatfacto": "splatfacto, 30,000 steps",
    "splatfacto-7k": "splatfacto, 7,000 steps",
    "sundae-warm-up": "the full field before the prune",
    "sundae": "**sundae**",
    "sundae-with-head": "sundae, with a head in any case",
    "sundae-no-head": "the same primitives, trained without a head",
    "mcmc": "3DGS-MCMC",
    "random-no-head": "random primitives",
    "contribution-no-head": "highest contribution, as LightGaussian",
}
"""Arms of runs.csv in the order of a table, by the names that readers see."""
HEADLINE = ("splatfacto", "sundae", "sundae-with-head")


def lines_of(name: str) -> list[dict[str, Any]]:
    """Rows of a results file, ``.jsonl`` or ``.csv``; cells of a CSV are text."""
    text = (RESULTS / name).read_text(encoding="utf-8")
    if name.endswith(".jsonl"):
        return [json.loads(line) for line in text.splitlines()]
    return list(csv.DictReader(text.splitlines()))


def runs() -> list[dict[str, Any]]:
    """Rows of runs.csv by capture, in the order of :data:`METHODS`; numbers are numbers, and None is an empty cell."""
    words = ("scene", "method", "variant", "resolution", "gpu", "command", "lpips_net")
    rows = [
        {name: cell if name in words else float(cell) if cell else None for name, cell in row.items()}
        for row in lines_of("runs.csv")
        if row["variant"] in METHODS
    ]
    return sorted(rows, key=lambda row: (row["scene"], list(METHODS).index(row["variant"])))


def first_of_each(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Rows whose first cell is left out where it repeats the one above."""
    seen = ""
    shown = []
    for first, *others in rows:
        shown.append([first if first != seen else "", *others])
        seen = first
    return shown


def headline() -> list[str]:
    """README's table: today's default beside stock splatfacto."""
    heads = ["capture", "method", "primitives", "PSNR", "SSIM", "PSNR head off", "MB", "ms a frame"]
    rows = [cells_of(row) for row in runs() if row["variant"] in HEADLINE]
    return table(heads, first_of_each(rows))


def quality() -> list[str]:
    """All methods on the captures: quality, size and time of the same rendering."""
    heads = ["capture", "method", "keep", "primitives", "PSNR, dB", "SSIM", "PSNR, head off", "MB", "ms a frame"]
    rows = []
    for row in runs():
        capture, method, *others = cells_of(row)
        keep = "" if row["keep_ratio"] is None else f"{row['keep_ratio']:.0%}"
        rows.append([capture, method, keep, *others])
    return table(heads, first_of_each(rows))


def cells_of(row: dict[str, Any]) -> list[str]:
    """Capture, method, number of primitives, metrics, size and time of a row of runs.csv."""
    return [
        f"{row['scene']}, {row['resolution'].replace('x', ' x ')}",
        METHODS[row["variant"]],
        *(number(row["primitives"], 0), number(row["psnr"], 2), number(row["ssim"], 4)),
        number(row["psnr_base"], 2) if row["bytes_head"] else "",
        *(number(row["bytes_total"] / MB, 1), number(row["ms_frame"], 2)),
    ]


def speed() -> list[str]:
    """Milliseconds of frames, each with the error of the same frames."""
    heads = ["field", "size", "head in", "primitives", "frame, ms", "splat, ms", "head, ms", "PSNR, dB", "SSIM", "GPU"]
    rows = [
        [
            *(line["config"], f"{line['width']} x {line['height']}", line["precision"] if line["ms_head"] else ""),
            *(number(line["primitives"], 0), number(line["ms_frame"], 2), number(line["ms_splat"], 2)),
            number(line["ms_head"], 2) if line["ms_head"] else "",
            *(number(line["psnr"], 2), number(line["ssim"], 4), gpu(line["device"])),
        ]
        for line in lines_of("frames.jsonl")
    ]
    return table(heads, first_of_each(rows))


def training_time() -> list[str]:
    """Seconds of whole trainings, each with the error of what was trained."""
    heads = ["capture", "method", "steps", "seconds", "ms a step", "primitives", "PSNR, dB", "SSIM", "GPU"]
    rows = [
        [
            *(line["scene"], line["arm"], number(line["steps"], 0), number(line["train_s"], 0)),
            number(1000 * line["train_s"] / line["steps"], 2),
            number(line["primitives"], 0),
            *(
                number(line[name], digits) if line[name] is not None else "-"
                for name, digits in (("psnr", 2), ("ssim", 4))
            ),
            gpu(line["gpu"]),
        ]
        for line in lines_of("training_time.jsonl")
    ]
    return table(heads, first_of_each(rows))


def packing() -> list[str]:
    """Packed runs: bytes, and PSNR and SSIM before and after."""
    heads = ["run", "fine-tuning", "primitives", "MB", "bits", "PSNR of the run", "packed", "SSIM of the run", "packed"]
    rows = []
    for line in lines_of("pack.jsonl"):
        if line["run"] is not None:
            steps = line["finetune_steps"]
            bits = 8 * line["bytes"] / line["primitives"]
            rows.append(
                [
                    *(line["run"], f"{steps:,} steps" if steps else "", number(line["primitives"], 0)),
                    *(number(line["bytes"] / MB, 2), number(bits, 0)),
                    *(number(line[name], 2) for name in ("psnr", "psnr_packed")),
                    *(number(line[name], 4) for name in ("ssim", "ssim_packed")),
                ]
            )
    return table(heads, first_of_each(rows))


def multi_gpu() -> list[str]:
    """Training on one and several GPUs."""
    heads = ["field", "GPUs", "primitives", "images a second", "PSNR, dB", "MiB of a GPU, at most"]
    rows = [
        [
            "tiled, not pruned" if "tiled" in line["variant"] else f"{line['scene']}, whole run",
            f"{line['ranks']} {gpu(line['gpu']).split()[-1]}",
            *(number(line["primitives"], 0), number(line["images_per_s"], 1)),
            number(list(line["psnr_after_images"].values())[-1], 2),
            number(max(line["peak_mib"]), 0),
        ]
        for line in sorted(lines_of("multi_gpu.jsonl"), key=lambda line: (line["variant"], line["ranks"]))
    ]
    return table(heads, first_of_each(rows))


def rules() -> list[str]:
    """Rules of pruning on two captures at three shares, 15,000 steps after the prune, without a head."""
    lines = lines_of("rules.csv")
    columns = list(dict.fromkeys((line["scene"], float(line["keep"])) for line in lines))
    cells = {(line["rule"], line["scene"], float(line["keep"])): line for line in lines}

    def cell(rule: str, column: tuple[str, float]) -> str:
        line = cells.get((rule, *column))
        if line is None:
            return "-"
        spread = f" ± {float(line['psnr_range']) / 2:.2f}" if int(line["seeds"]) > 1 else ""
        return f"{float(line['psnr']):.2f}{spread}"

    def total(rule: str) -> float:
        return -sum(float(cells[(rule, *column)]["psnr"]) for column in columns if (rule, *column) in cells)

    heads = ["rule", *(f"{name}, {keep:.0%}" for name, keep in columns)]
    names = sorted({line["rule"] for line in lines}, key=total)
    return table(heads, [[name, *(cell(name, column) for column in columns)] for name in names], words=1)


def trials() -> list[str]:
    """What held-out training views say of the head and of regularisers, and the finished run on test views."""
    heads = ["capture", "training views", "held out", "head: dB", "SSIM", "regularisers: dB", "SSIM"]
    heads += ["chosen", "dB, test", "SSIM, test"]
    rows = []
    for line in lines_of("trials.csv"):
        arms = [(name, arm) for arm in ("head", "regularised") for name in ("psnr", "ssim")]
        gains = [float(line[f"{name}_{arm}"]) - float(line[f"{name}_plain"]) for name, arm in arms]
        rows.append(
            [
                *(line["capture"], line["training_views"], line["held_out"]),
                *(f"{gains[0]:+.2f}", f"{gains[1]:+.4f}", f"{gains[2]:+.2f}", f"{gains[3]:+.4f}", line["chosen"]),
                *(number(float(line["psnr_test"]), 2), number(float(line["ssim_test"]), 4)),
            ]
        )
    return table(heads, rows)


def gpu(name: str) -> str:
    """Name of a device as tables show it."""
    return name.replace("NVIDIA ", "").replace(" 80GB HBM3", "")


TABLES: dict[str, Callable[[], list[str]]] = {
    "headline": headline,
    "quality": quality,
    "speed": speed,
    "training-time": training_time,
    "packing": packing,
    "multi-gpu": multi_gpu,
    "rules": rules,
    "trials": trials,
}


def with_tables(text: str) -> str:
    """A page with its tables made anew.

    Raises:
        KeyError: a marker names no table.
    """
    return MARKED.sub(lambda found: found[1] + "\n".join(TABLES[found["name"]]()) + "\n" + found[3], text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", nargs="?", choices=TABLES, help="print this table, and rewrite nothing")
    options = parser.parse_args()
    if options.table:
        print("\n".join(TABLES[options.table]()))
        return
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if with_tables(text) != text:
            page.write_text(with_tables(text), encoding="utf-8")
            print(f"wrote {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
