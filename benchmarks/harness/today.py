"""Fingerprints that a row of results must have to be of today's default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from harness.arms import DEFAULT_FILE, choose_arms, read_entries
from harness.job import fingerprint_of
from harness.plan import WARM_UP, plan_scene

EARLIER = "earlier default"
"""Words that mark a row which is not of today's default."""
SHARE = 0.1
"""Share of the primitives that ``sundae`` keeps."""


def is_of_today(row: Mapping[str, Any]) -> bool:
    """Whether a row of ``runs.csv`` was measured with the options that its arm has today.

    Args:
        row: with ``variant``, ``keep_ratio`` and ``fingerprint``, as text or as values; without one of them, it was
            not.
    """
    return row.get("fingerprint") in fingerprints(str(row.get("variant", "")), float(row.get("keep_ratio") or SHARE))


@cache
def fingerprints(arm: str, keep_ratio: float) -> frozenset[str]:
    """Today's fingerprints of a default arm, or of a warm-up, at a share; none of another arm.

    An arm has two if it may start from a warm-up and may train whole.
    """
    # All arms of a method share its warm-up.
    name = "sundae-no-head" if arm == f"sundae-{WARM_UP}" else arm
    if name not in {entry.name for entry in read_entries(DEFAULT_FILE)}:
        return frozenset()
    (found,) = choose_arms([name], "sundae")
    ways = [found]
    if found.kind == "branch":
        ways.append(replace(found, kind="whole", steps=found.total, at_every_ratio=True))
    jobs = [
        job
        for way in ways
        for job in plan_scene(Path("capture"), (), [way], keep_ratios=[keep_ratio], seeds=[42], repeat_at=[])
    ]
    return frozenset(fingerprint_of(job) for job in jobs if job.arm == arm)
