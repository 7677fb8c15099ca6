"""Rows of curve.csv and runs.csv from results of leases: curve_rows.py FOLDER, which holds suite-* and quality-*

Rows take the place of those of the same capture, method or variant, share (the default: chosen by itself) and seed.
"""

import csv
import json
import sys
from pathlib import Path

RESULTS = Path("benchmarks/results")
COMMIT = "57509540"
SHORT = "keep_ratio psnr ssim psnr_base ssim_base psnr_fitted peak_vram_mib ms_frame ms_splat ms_head train_s prune_s".split()
folder = Path(sys.argv[1])


def short(value):
    return f"{float(value):.4f}".rstrip("0").rstrip(".") if value not in ("", None) else ""


def put(name, mine, key):
    with (RESULTS / name).open(newline="") as file:
        rows = list(csv.DictReader(file))
    new = {key(row): row for row in mine}
    found = {key(row) for row in rows}
    rows = [new.get(key(row), row) for row in rows] + [row for k, row in new.items() if k not in found]
    print(name, len(new), "rows,", sum(k not in found for k in new), "of them new")
    with (RESULTS / name).open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def curve_row(result, row, chosen):
    packed, tuned = result["packed"], result["tuned"]
    return {"capture": row["scene"], "method": "sundae", "prune_at": 12000,
            "share": short(row["keep_ratio"]) if chosen else str(float(row["keep_ratio"])), "primitives": row["primitives"],
            "packed_bytes": packed["bytes"], "psnr": short(row["psnr"]), "ssim": short(row["ssim"]),
            "packed_psnr": short(packed["psnr"]), "packed_ssim": short(packed["ssim"]), "tuned_bytes": tuned["bytes"],
            "tuned_psnr": short(tuned["psnr"]), "tuned_ssim": short(tuned["ssim"]), "head": "yes" if int(row["bytes_head"]) > 0 else "no",
            "seed": row["seed"], "chosen": "yes" if chosen else "no", "seconds": ""}  # fmt: skip


def flat(result):
    m = result["measured"]
    on = m["configurations"][0]["mean"]
    return {"scene": m["scene"], "keep_ratio": m["keep_ratio"], "primitives": m["primitives"], "psnr": on["psnr"], "ssim": on["ssim"],
            "bytes_head": m["bytes_head"], "seed": m["seed"]}  # fmt: skip


curve, runs, times = [], [], []
for path in sorted(folder.glob("quality-*/done/*.json")):
    result = json.loads(path.read_text())
    if "warm-up" not in path.name and result.get("packed"):
        curve.append(curve_row(result, flat(result), False))
for path in sorted(folder.glob("quality-*/results.csv")):
    for row in csv.DictReader(path.open()):
        if row["variant"] == "sundae" and row["keep_ratio"] != "1.0":
            runs.append({name: short(value) if name in SHORT else value for name, value in row.items()})
for suite in sorted(folder.glob("suite-*")) + sorted(folder.glob("splatfacto-*")) + sorted(folder.glob("mcmc-*")):
    if not (suite / "results.csv").exists():
        continue
    for row in csv.DictReader((suite / "results.csv").open()):
        row |= {name: short(row[name]) for name in SHORT}
        row["keep_ratio"] = {"splatfacto": "1.0", "mcmc": "0.1"}.get(row["variant"], row["keep_ratio"])
        runs.append(row)
    for line in (suite / "results.jsonl").read_text().splitlines():
        result = json.loads(line)
        if result["alone"]:
            flat_row = next(row for row in runs if row["scene"] == result["job"]["scene"] and str(row["seed"]) == str(result["job"]["seed"]) and row["method"] == result["job"]["method"])
            times.append({"arm": flat_row["method"], "scene": flat_row["scene"], "steps": 30000, "seed": int(flat_row["seed"]), "train_s": round(float(flat_row["train_s"]), 2),
                          "ms_frame": float(flat_row["ms_frame"]), "psnr": float(flat_row["psnr"]), "ssim": float(flat_row["ssim"]), "primitives": int(flat_row["primitives"]),
                          "head": int(flat_row["bytes_head"]) > 0, "peak_mib": round(float(flat_row["peak_vram_mib"])), "gpu": flat_row["gpu"], "commit": COMMIT})  # fmt: skip
        if result["job"]["arm"] == "sundae-auto":
            curve.append(curve_row(result, flat(result), True))
for row in curve:
    print({k: row[k] for k in ("capture", "share", "primitives", "packed_bytes", "psnr", "ssim", "tuned_bytes", "tuned_psnr", "head")})
put("curve.csv", curve, lambda row: (row["capture"], row["method"], row["seed"] if isinstance(row["seed"], str) else str(row["seed"]), "chosen" if row["chosen"] == "yes" else float(row["share"])))
put("runs.csv", runs, lambda row: (row["scene"], row["variant"], row["seed"], row["keep_ratio"] if row["variant"] == "sundae" else "", row["steps"]))
path = RESULTS / "training_time.jsonl"
rows = [json.loads(line) for line in path.read_text().splitlines()]
new = {(row["arm"], row["scene"]): row for row in times}
rows = [new.pop((row["arm"], row["scene"]), row) for row in rows] + list(new.values())
path.write_text("".join(json.dumps(row) + "\n" for row in rows))
print("training_time.jsonl", len(times), "rows")
