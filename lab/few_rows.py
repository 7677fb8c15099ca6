"""Rows of few_counts.csv from results of few_arms.py: few_rows.py FOLDER (holds JOB/result.json)"""

import json
import sys
from pathlib import Path

sys.path.insert(0, "benchmarks")
from few_views import COLUMNS  # noqa: E402

from harness.rows import Rows  # noqa: E402

rows = Rows(Path("benchmarks/results/few_counts.csv"), COLUMNS, COLUMNS[:4])
for path in sorted(Path(sys.argv[1]).glob("*/result.json")):
    result = json.loads(path.read_text())
    capture, _, views = result["set"].rpartition("-")
    configuration = result["measured"]["configurations"][0]
    mean = configuration.get("mean", configuration)
    print(path.parent.name, json.dumps(result["measured"])[:600] if "-v" in sys.argv else "")
    count = result["measured"]["primitives"] if "primitives" in result["measured"] else configuration["primitives"]
    head = "on" if result["measured"].get("bytes", {}).get("head") or configuration.get("head") else "off"
    rows.put(dict(zip(COLUMNS, (capture, views, result["seed"], result["arm"], count, head, f"{mean['psnr']:.3f}", f"{mean['ssim']:.4f}"))))
