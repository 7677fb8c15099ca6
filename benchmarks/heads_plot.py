"""What a head gains against its milliseconds and against its bytes: python benchmarks/heads_plot.py [-o FIGURE].

Gains are those of ``branches.jsonl`` over the same field without a head (4,000 steps, pruned to 10%), milliseconds those of
``heads.jsonl`` (824 x 1240, fp16, kernels; one H100, or an H200 where no H100 has timed it, which is then said). The paper
prints gains of its three sizes on two other scenes; the milliseconds that they stand at are ours of the same heads.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from sundae_ns.compensation import HeadConfig

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
FIGURE = ROOT / "docs" / "figures" / "heads.png"
STEPS, GPU = 4000, "H100"


class Head(NamedTuple):
    """What tells heads apart, as ``heads.jsonl`` has it."""

    size: str
    num_features: int
    pixel_unshuffle: int


VARIANTS = {
    "compact, 5 features": Head("compact", 5, 2),
    "compact, 13 features": Head("compact", 13, 2),
    "compact, 64 wide, 13 features": Head("wide", 13, 2),
    "small, 5 features": Head("small", 5, 2),
    "small, 13 features": Head("small", 13, 2),
    "regular (paper's size), full resolution, 13 features": Head("regular", 13, 1),
}
"""Names in ``branches.jsonl`` of heads that were timed."""

PAPER_MB = {"small": 7.2, "regular": 30.0, "large": 120.0}
PAPER = {"bicycle": (0.08, 0.43, 0.20), "garden": (0.65, 0.80, 0.68)}
"""PSNR of the paper's small, regular and large network at 10% less that without one, from its ablations; printed there."""


def lines(name: str) -> list[dict]:  # type: ignore[type-arg]
    return [json.loads(line) for line in (RESULTS / name).read_text(encoding="utf-8").splitlines()]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=FIGURE)
    options = parser.parse_args()
    branches = [line for line in lines("branches.jsonl") if line["steps"] == STEPS]
    timed = {
        Head(line["size"], line["num_features"], line["pixel_unshuffle"]): line
        for line in sorted(lines("heads.jsonl"), key=lambda line: GPU in line["gpu"])  # the last one counts
    }
    figure, (by_time, by_bytes) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained", sharey=True)
    for color, scene in zip(("tab:blue", "tab:orange"), dict.fromkeys(line["scene"] for line in branches)):
        psnr = {line["name"]: line["psnr"] for line in branches if line["scene"] == scene}
        names = [name for name in VARIANTS if name in psnr]
        gains = [psnr[name] - psnr["no head"] for name in names]
        ms = [timed[VARIANTS[name]]["ms_824x1240"] for name in names]
        megabytes = [4e-6 * timed[VARIANTS[name]]["parameters"] for name in names]
        for panel, places in ((by_time, ms), (by_bytes, megabytes)):
            panel.scatter(places, gains, color=color, label=f"{scene}, measured", zorder=3)
            for name, x, y in zip(names, places, gains):
                size, features, _ = VARIANTS[name]
                default = (size, features) == (HeadConfig.size, HeadConfig.num_features)
                gpu = timed[VARIANTS[name]]["gpu"]
                other = f" ({gpu.split()[1]})" if panel is by_time and GPU not in gpu else ""
                text = f"{size}, {features}" + ", default" * default + other
                left = (size, features) == ("compact", 13)
                offset = (-5, 4) if left else (6, 5 if default else -11)
                panel.annotate(
                    text, (x, y), offset, textcoords="offset points", fontsize=7, ha="right" if left else "left"
                )
    for marker, (scene, printed) in zip("^v", PAPER.items()):
        gray = {"color": "gray", "mfc": "none", "label": f"{scene}, printed in the paper"}
        by_bytes.plot([*PAPER_MB.values()], printed, marker + ":", **gray)
        # Our milliseconds of the sizes that were timed at full resolution, as the paper runs them.
        heads = [timed.get(Head(size, 13, 1)) for size in PAPER_MB]
        known = [(head["ms_824x1240"], gain) for head, gain in zip(heads, printed) if head is not None]
        by_time.plot(*zip(*known), marker + ":", **gray)
    by_time.axvline(1.3, color="gray", lw=0.8, ls="--")
    by_time.annotate("asked for", (1.3, 0.02), (3, 0), textcoords="offset points", fontsize=7, color="gray")
    by_time.set_xlabel("ms of the head, 824 x 1240, fp16, H100")
    by_bytes.set_xlabel("MB of the head in fp32")
    by_time.set_ylabel("gain over no head, dB PSNR")
    for panel in (by_time, by_bytes):
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter("")
        panel.set_ylim(bottom=0)
        panel.grid(alpha=0.3, which="both")
    figure.legend(*by_bytes.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4)
    by_time.set_xlim(0.36, 13)
    by_bytes.set_xlim(1.0, 150)
    by_time.set_xticks([0.5, 1, 2, 5, 10])
    by_bytes.set_xticks([2, 5, 10, 20, 50, 100])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, dpi=110)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
