"""Put results of suites in place: record_rows.py FOLDER... reads every results.jsonl below, of the default only."""

import csv
import json
import sys
from pathlib import Path

RESULTS = Path("benchmarks/results")
COMMIT = "70f5e1cb"


def rewrite(name, mine, keep):
    rows = list(csv.DictReader((RESULTS / name).open()))
    columns = list(rows[0])
    kept = [row for row in rows if keep(row)]
    with (RESULTS / name).open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(kept + mine)


found, tables = [], {}
for folder in map(Path, sys.argv[1:]):
    for path in sorted(folder.rglob("results.jsonl")):
        found += [json.loads(line) for line in path.read_text().splitlines()]
        for row in csv.DictReader((path.parent / "results.csv").open()):
            tables[row["scene"], int(row["seed"])] = row
found.sort(key=lambda r: (r["job"]["scene"], r["job"]["seed"]))
short = lambda value: f"{float(value):.4f}".rstrip("0").rstrip(".") if value not in ("", None) else ""
runs, curve, times = [], [], []
for result in found:
    scene, seed = result["job"]["scene"], result["job"]["seed"]
    row = dict(tables[scene, seed])
    for name in ("keep_ratio", "psnr", "ssim", "psnr_base", "ssim_base", "psnr_fitted", "peak_vram_mib"):
        row[name] = short(row[name])
    for name in ("ms_frame", "ms_splat", "ms_head", "train_s", "prune_s"):
        row[name] = short(row[name])
    runs.append(row)
    head = int(row["bytes_head"]) > 0
    packed, tuned = result["packed"], result["tuned"]
    curve.append({"capture": scene, "method": "sundae", "prune_at": 12000, "share": row["keep_ratio"], "primitives": row["primitives"],
                  "packed_bytes": packed["bytes"], "psnr": row["psnr"], "ssim": row["ssim"],
                  "packed_psnr": short(packed["psnr"]), "packed_ssim": short(packed["ssim"]), "tuned_bytes": tuned["bytes"],
                  "tuned_psnr": short(tuned["psnr"]), "tuned_ssim": short(tuned["ssim"]), "head": "yes" if head else "no",
                  "seed": seed, "chosen": "yes", "seconds": row["train_s"]})  # fmt: skip
    if result["alone"]:
        quality = {"psnr": float(row["psnr"]), "ssim": float(row["ssim"]), "primitives": int(row["primitives"])}
        times.append({"arm": "sundae", "scene": scene, "steps": 30000, "seed": seed, "train_s": round(float(row["train_s"]), 2), "ms_frame": float(row["ms_frame"]), **quality,
                      "head": head, "peak_mib": round(float(row["peak_vram_mib"])), "gpu": row["gpu"], "commit": COMMIT})  # fmt: skip
rewrite("runs.csv", runs, lambda row: row["variant"] != "sundae-auto")
rewrite("curve.csv", curve, lambda row: row["chosen"] != "yes")
path = RESULTS / "training_time.jsonl"
kept = [row for row in map(json.loads, path.read_text().splitlines()) if row["arm"] != "sundae"]
path.write_text("".join(json.dumps(row) + "\n" for row in times + kept))
