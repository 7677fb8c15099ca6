"""The measured runs as Markdown tables.

    python benchmarks/tables.py [results/runs.csv]     # prints all rows, a table for each scene
    python benchmarks/tables.py --readme               # writes README's table anew, between its markers

tests/test_readme.py checks that README's table is what this makes of runs.csv and, for packed scenes, of pack.jsonl. Branches,
whose frames nobody timed, are not printed: ``rules_report.py`` shows them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

from sundae_ns.evaluation import RunRow, read_rows
from sundae_ns.evaluation.document import number, table

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "benchmarks" / "results" / "runs.csv"
PACKS = ROOT / "benchmarks" / "results" / "pack.jsonl"
README = ROOT / "README.md"
BEGIN = "<!-- made by: python benchmarks/tables.py --readme -->"
END = "<!-- end of what is made -->"
MB = 1e6


@dataclass(frozen=True)
class Shown:
    """A line of README's table: which row of runs.csv, and what it is called there."""

    scene: str
    method: str
    variant: str
    commit: str
    label: str
    timed: bool = True
    """Whether its times stand beside those of the other rows of the scene."""
    packed: str = ""
    """Name in pack.jsonl, where lines for the packed run are to follow."""


SHOWN = (
    Shown("bonsai", "splatfacto", "peers-splatfacto", "04e59ca", "splatfacto"),
    Shown("bonsai", "sundae", "peers-sundae", "04e59ca", "**sundae**"),
    Shown("bonsai", "sundae", "peers-mcmc", "04e59ca", "3DGS-MCMC"),
    Shown("bonsai", "sundae", "peers-contribution-no-head", "04e59ca", "contribution pruning, as LightGaussian's"),
    Shown("bonsai", "sundae", "band-positions", "2e7bd23", "the paper's band rule (an older head)", timed=False),
    Shown("bonsai", "sundae", "default", "8b20125", "another run of sundae", timed=False, packed="bonsai-default-42"),
    Shown("fox", "splatfacto", "default", "5e4bc58", "splatfacto"),
    Shown("fox", "sundae", "default", "ef71d9f", "**sundae**", packed="fox, 30,000 steps"),
    Shown("fox", "sundae", "no-head-branch", "ef71d9f", "the same field, no head", timed=False),
)


def readme_table(rows: list[RunRow]) -> str:
    """README's table, of the rows that it shows."""
    lines, scene = [], ""
    for shown in SHOWN:
        key = (shown.scene, shown.method, shown.variant, shown.commit)
        (row,) = [row for row in rows if (row.scene, row.method, row.variant, row.commit) == key]
        first = "" if shown.scene == scene else f"{row.scene}, {row.resolution.replace('x', ' x ')}"
        scene = shown.scene
        lines.append(
            [
                first,
                shown.label,
                number(row.primitives, 0),
                *(number(row.psnr, 2), number(row.ssim, 4), number(row.psnr_base, 2)),
                number(row.bytes_total / MB, 1),
                number(row.ms_frame, 2) if shown.timed else "",
                f"{number(row.train_s, 0)} s" if shown.timed and row.train_s is not None else "",
            ]
        )
        if shown.packed:
            lines += packed_lines(shown.packed)
    heads = ["scene", "method", "primitives", "PSNR", "SSIM", "PSNR, head off", "MB", "ms a frame", "training"]
    return "\n".join(table(heads, lines))


def with_spread(values: Sequence[float]) -> str:
    """Mean, and half the range of several: ``28.29 ± 0.04``."""
    spread = f" ± {(max(values) - min(values)) / 2:.2f}" if len(values) > 1 else ""
    return f"{mean(values):.2f}{spread}"


def packed_lines(run: str) -> list[list[str]]:
    """README's lines of a run packed with the default options, as it is and fine-tuned; the last measurements count."""
    measured = [json.loads(line) for line in PACKS.read_text(encoding="utf-8").splitlines()]
    last = {line.get("finetune_steps", 0): line for line in measured if line["run"] == run and not line["set"]}
    lines = []
    for steps, found in sorted(last.items()):
        label = "the same, packed" + (f" with --finetune {steps}" if steps else "")
        quality = (number(found["psnr_packed"], 2), "", number(found["psnr_packed_base"], 2))
        lines.append(["", label, number(found["primitives"], 0), *quality, number(found["bytes"] / MB, 1), "", ""])
    return lines


def with_table(text: str, rows: list[RunRow]) -> str:
    """README with its table made anew."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    if not after:
        raise SystemExit(f"README has no markers; put these lines around its table: {BEGIN} and {END}")
    return f"{before}{BEGIN}\n{readme_table(rows)}\n{END}{after}"


def scene_tables(rows: list[RunRow]) -> str:
    """All rows, a table for each scene."""
    heads = ["method", "variant", "keep", "primitives", "PSNR", "SSIM", "PSNR, head off", "MB"]
    heads += ["ms a frame", "train s", "prune s", "peak primitives", "peak MiB", "commit", "GPU"]
    parts = []
    for scene in dict.fromkeys(row.scene for row in rows):
        own = [row for row in rows if row.scene == scene and row.ms_frame is not None]
        lines = [
            [
                *(row.method, row.variant, "" if row.keep_ratio is None else f"{row.keep_ratio:.0%}"),
                *(number(row.primitives, 0), number(row.psnr, 2), number(row.ssim, 4), number(row.psnr_base, 2)),
                *(number(row.bytes_total / MB, 1), number(row.ms_frame, 2)),
                *(number(row.train_s, 0), number(row.prune_s, 1)),
                *(number(row.peak_primitives, 0), number(row.peak_vram_mib, 0)),
                *(row.commit, row.gpu.replace("NVIDIA ", "")),
            ]
            for row in sorted(own, key=lambda row: (row.method, row.commit, row.variant))
        ]
        title = f"**{scene}**, {own[0].resolution} px, every 8th image for test"
        parts += ["", title, "", *table(heads, lines)]
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="?", default=RUNS)
    parser.add_argument("--readme", action="store_true", help="write README's table anew")
    options = parser.parse_args()
    rows = read_rows(options.runs)
    if options.readme:
        README.write_text(with_table(README.read_text(encoding="utf-8"), rows), encoding="utf-8")
    else:
        print(scene_tables(rows))


if __name__ == "__main__":
    main()
