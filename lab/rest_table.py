"""Rows of rests.csv from results of rest_curves.py, and on stderr what a rest gains and misses: rest_table.py FILE... > rests.csv"""

import csv
import json
import sys
from pathlib import Path

SSIM_WEIGHT, LEAST_LOSS = 0.2, 0.005  # of the model's default and of sundae_ns/train/choice.py
out = csv.writer(sys.stdout, lineterminator="\n")
out.writerow("capture,views,seed,head,steps,psnr_held,ssim_held,psnr,ssim".split(","))
sums = [0.0, 0.0]
for file in sorted(sys.argv[1:]):
    result = json.loads(Path(file).read_text())
    name, _, views = result["capture"].rpartition("-") if result["capture"][-1].isdigit() else (result["capture"], "", "26")
    losses, tests = [], []
    for i, row in enumerate(result["rows"]):
        pixels = sum(view[0] for view in row["held"])
        psnr, ssim = (sum(view[0] * view[k] for view in row["held"]) / pixels for k in (1, 2))
        losses.append((1 - SSIM_WEIGHT) * 10 ** (-psnr / 20) + SSIM_WEIGHT * (1 - ssim))
        tests.append((row["test"]["psnr"], row["test"]["ssim"]))
        if i + 1 in (1, 2, 3, 5, 9, 17) or row is result["rows"][-1]:
            figures = f"{psnr:.3f}", f"{ssim:.4f}", f"{tests[-1][0]:.3f}", f"{tests[-1][1]:.4f}"
            out.writerow([name, views, result["seed"], result["trials"]["head"]["decision"], 600 * (i + 1), *figures])
    for end in range(1, len(losses) + 1):
        best = losses.index(min(losses[:end]))
        if losses[end - 1] >= (1 + LEAST_LOSS) * losses[best]:
            break
    missed = [max(values) - value for values, value in zip(zip(*tests), tests[best])]
    gained = [value - last for value, last in zip(tests[best], tests[-1])]
    sums = [total + gain for total, gain in zip(sums, gained)]
    print(f"{result['capture']}: {best + 1} windows miss {missed[0]:.2f} dB, {missed[1]:.4f}; gain {gained[0]:.2f}, {gained[1]:.4f}", file=sys.stderr)
print("mean gain", *(total / len(sys.argv[1:]) for total in sums), file=sys.stderr)
