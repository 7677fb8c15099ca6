"""What a search leaves in the run's folder: ``budget.json``, and the curve drawn in ``budget.txt``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict

from sundae_ns.compensation import HeadConfig
from sundae_ns.evaluation import without_nan
from sundae_ns.pruning import PruningConfig
from sundae_ns.storage.atomic import write_text
from sundae_ns.training.budget.run import Run
from sundae_ns.training.budget.search import Point, Search
from sundae_ns.training.budget.sizes import bytes_of, chosen_head


def wanted(config: PruningConfig) -> tuple[str, float]:
    """The option that says what is to be kept, and how much."""
    for name in ("max_bytes", "max_primitives"):
        value = getattr(config, name)
        if value is not None:
            return name, value
    return "max_psnr_drop", config.tolerated_drop


def point_of(run: Run, search: Search, largest: HeadConfig | None, psnr: float, *, phase: str, verdict: str) -> Point:
    """One look at the held-back views, for the curve.

    Args:
        run: whose field was looked at.
        search: where it stands.
        largest: the largest head that may be chosen.
        psnr: mean over the views, dB.
        phase, verdict: see :class:`sundae_ns.training.budget.search.Point`.
    """
    head = chosen_head(search, largest) if search.head else None
    return Point(
        step=run.model.step,
        phase=phase,
        primitives=run.model.num_points,
        bytes=bytes_of(run.params if search.head else run.bare, head),
        psnr=psnr,
        verdict=verdict,
        since_cut=run.model.schedule_step - search.cut_at,
    )


def write(run: Run, config: PruningConfig, search: Search) -> None:
    """Write the curve, the choice, and what it cost, if there is a folder to write to.

    Raises:
        StorageError: no room or no right to write.
    """
    trainer = run.attributes.trainer
    if trainer is None:
        return
    content = {
        "budget": dict([wanted(config)]),
        **asdict(search),
        "primitives": run.model.num_points,
        "cost": {
            "steps_lost": search.steps_lost,
            "share_of_steps": search.steps_lost / trainer.config.max_num_iterations,
            "seconds": search.seconds,
        },
    }
    folder = trainer.base_dir
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "budget.json", json.dumps(without_nan(content), indent=2, allow_nan=False))
    write_text(folder / "budget.txt", curve_text(search.curve, search.target) + "\n")


def curve_text(points: Sequence[Point], target: float, width: int = 40) -> str:
    """The curve as lines of text, one a look, the fewest primitives last; bars are dB above the worst look."""
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
