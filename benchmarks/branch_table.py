"""Print the branches as a Markdown table, scenes side by side: python benchmarks/branch_table.py [STEPS]."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

BRANCHES = Path(__file__).parent / "results" / "branches.jsonl"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("steps", type=int, nargs="?", default=4000, help="length of the fine-tunes to show")
    steps = parser.parse_args().steps
    lines = [json.loads(line) for line in BRANCHES.read_text().splitlines()]
    if steps not in (known := sorted({line["steps"] for line in lines})):
        parser.error(f"there are no branches of {steps} steps; give one of {', '.join(map(str, known))}")
    lines = [line for line in lines if line["steps"] == steps]
    scenes = list(dict.fromkeys(line["scene"] for line in lines))
    by_name: dict[str, dict[str, dict[str, float]]] = {}
    for line in lines:
        by_name.setdefault(line["name"], {})[line["scene"]] = line
    plain = by_name["no head"]
    print("| variant | " + " | ".join(f"{s}: PSNR (gain) | SSIM | head off | training views" for s in scenes) + " |")
    print("|---|" + "---|" * (4 * len(scenes)))
    first = scenes[0]
    for name, runs in sorted(by_name.items(), key=lambda item: -item[1].get(first, plain[first])["psnr"]):
        cells = []
        for scene in scenes:
            if scene not in runs:
                cells += ["", "", "", ""]
                continue
            run, gain = runs[scene], runs[scene]["psnr"] - plain[scene]["psnr"]
            cells += [f"{run['psnr']:.2f} ({gain:+.2f})", f"{run['ssim']:.4f}"]
            cells += [f"{run['psnr_base']:.2f}", f"{run['train_psnr']:.2f}"]
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
