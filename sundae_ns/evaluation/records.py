"""Measured runs as rows of a CSV file such as ``benchmarks/results/runs.csv``."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from typing import Any

COLUMNS = (
    *("scene", "method", "variant", "keep_ratio", "seed", "steps", "primitives"),
    *("psnr", "ssim", "psnr_base", "ssim_base", "lpips", "lpips_net"),
    *("bytes_primitives", "bytes_head", "bytes_total", "ms_frame", "ms_splat", "ms_head"),
    *("train_s", "prune_s", "peak_primitives", "peak_vram_mib", "gpu", "resolution", "fingerprint", "command"),
)
"""Metrics are means over the test views, ``*_base`` without the head; ``bytes_*`` are bytes, ``ms_*`` milliseconds per
frame, ``*_s`` seconds, and ``peak_vram_mib`` is the peak that torch allocated during training, MiB; ``fingerprint`` stands
for the options of the run."""


def csv_text(runs: Sequence[Mapping[str, Any]]) -> str:
    """Runs as CSV with a header; an empty cell means not measured.

    Args:
        runs: from :meth:`sundae_ns.evaluation.Measured.as_json`.
    """
    buffer = StringIO()
    writer = csv.DictWriter(buffer, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for run in runs:
        full, base = run["configurations"][0], run["configurations"][-1]
        # Each time stands beside the metrics of its own renderings.
        own = {"ms_frame": full["ms"], "ms_splat": base["ms"], **full["mean"]}
        own |= {"psnr_base": base["mean"]["psnr"], "ssim_base": base["mean"]["ssim"]}
        own["lpips_net"] = run["lpips_net"] if own["lpips"] is not None else ""
        writer.writerow({**run, **own})
    return buffer.getvalue()
