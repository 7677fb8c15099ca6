"""The files of ``benchmarks/results``, and the names that readers see."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "results"
MB = 1e6

METHODS = {
    "splatfacto": "splatfacto, 30,000 steps",
    "splatfacto-7k": "splatfacto, 7,000 steps",
    "sundae-auto": "**sundae**",
    "sundae-warm-up": "full field, not pruned",
    "sundae-fast": "sundae-fast",
    "sundae": "sundae, fixed share",
    "sundae-with-head": "sundae, with a head in any case",
    "sundae-no-head": "the same Gaussians, no head",
    "sundae-no-head-bytes": "more Gaussians in place of a head",
    "mcmc": "3DGS-MCMC",
    "band": "the paper's band rule",
    "random-no-head": "random Gaussians",
    "contribution-no-head": "highest contribution, as LightGaussian",
}
"""Arms of runs.csv in the order of a table, by the names that readers see."""


def lines_of(name: str) -> list[dict[str, Any]]:
    """Rows of a results file, ``.jsonl`` or ``.csv``; cells of a CSV are text."""
    text = (RESULTS / name).read_text(encoding="utf-8")
    if name.endswith(".jsonl"):
        return [json.loads(line) for line in text.splitlines()]
    return list(csv.DictReader(text.splitlines()))
