"""Bytes of our smallest packs at the PSNR, and at the SSIM, of stock's .sog by splat-transform (docs/results.md, "Packed
against packed"): measured packs that reach it, or a line between neighbouring fixed shares in the log of the bytes.
python lab/equal.py; to become a table of benchmarks/tables.py."""
import csv, json, math
from pathlib import Path
from statistics import fmean

R = Path(__file__).parents[1] / "benchmarks" / "results"
packs = {}
for row in csv.DictReader((R / "curve.csv").open()):
    if row["tuned_bytes"]:
        fixed = row["method"] == "sundae" and row["chosen"] == "no"
        packs.setdefault(row["capture"], []).append((int(row["tuned_bytes"]), float(row["tuned_psnr"]), float(row["tuned_ssim"]), fixed))
for line in map(json.loads, (R / "pack.jsonl").read_text().splitlines()):
    if line.get("variant") == "sundae-fast" and line["finetune_steps"]:
        packs[line["run"]].append((line["bytes"], line["psnr_packed"], line["ssim_packed"], False))
for at, name in ((1, "psnr"), (2, "ssim")):
    shares = []
    for row in csv.DictReader((R / "formats.csv").open()):
        if row["format"] != ".sog" or not row["program"].startswith("splat-transform"): continue
        found, aim = packs[row["capture"]], float(row[name])
        sizes = [pack[0] for pack in found if pack[at] >= aim]
        fixed = sorted(pack for pack in found if pack[3])
        for a, b in zip(fixed, fixed[1:]):
            if a[at] < aim <= b[at]:
                t = (aim - a[at]) / (b[at] - a[at])
                sizes.append(math.exp((1 - t) * math.log(a[0]) + t * math.log(b[0])))
        shares.append(min(sizes) / int(row["bytes"]))
        print(name, row["capture"], f"1/{1 / shares[-1]:.1f}")
    print(name, "mean of", len(shares), f"1/{1 / fmean(shares):.1f}")
