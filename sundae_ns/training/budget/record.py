"""Records of a search in the run's folder: ``budget.json``, and its curve as text in ``budget.txt``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict

from sundae_ns.evaluation import without_nan
from sundae_ns.storage.atomic import write_text
from sundae_ns.training.budget.search import Point, Search
from sundae_ns.training.budget.searched_field import SearchedField
from sundae_ns.training.pruning_config import PruningConfig


def budget_of(config: PruningConfig) -> tuple[str, float]:
    """Name and value of the option that sets the budget."""
    for name in ("max_bytes", "max_primitives"):
        value = getattr(config, name)
        if value is not None:
            return name, value
    return "max_psnr_drop", config.tolerated_drop


def write(searched: SearchedField, search: Search) -> None:
    """Write curve, choice and cost of a search, if the run has a folder.

    Raises:
        StorageError: no space or no right to write.
    """
    folder, num_steps = searched.run.folder, searched.run.num_steps
    if folder is None or num_steps is None:
        return
    content = {
        "budget": dict([budget_of(searched.config)]),
        **asdict(search),
        "primitives": searched.count,
        "cost": {
            "steps_lost": search.steps_lost,
            "share_of_steps": search.steps_lost / num_steps,
            "seconds": search.seconds,
        },
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "budget.json", json.dumps(without_nan(content), indent=2, allow_nan=False))
    write_text(folder / "budget.txt", curve_text(search.curve, search.target) + "\n")


def curve_text(points: Sequence[Point], target: float, width: int = 40) -> str:
    """The curve as text, one line for each evaluation, sorted by falling number of primitives.

    Args:
        points: the evaluations.
        target: PSNR to keep, dB; a ``|`` marks it.
        width: characters of the longest bar. Bars are dB above the lowest evaluation.
    """
    if not points:
        return ""
    low = min([point.psnr for point in points] + [target])
    span = max([point.psnr for point in points] + [target]) - low or 1.0
    mark = round((target - low) / span * (width - 1))
    lines = []
    for point in sorted(points, key=lambda point: (-point.primitives, point.step)):
        bar = list("#" * round((point.psnr - low) / span * (width - 1)) + " " * width)[:width]
        bar[mark] = "|"
        lines.append(
            f"{point.primitives:>10,}  {''.join(bar)} {point.psnr:7.3f} dB  {point.psnr - target:+.3f} to the target  "
            f"step {point.step}, {point.since_cut} after the cut, {point.phase}, {point.verdict}"
        )
    return "\n".join(lines)
