"""Reports of prunes: one line for the log, numbers for the event file, ``prune.json`` in the run's folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from sundae_ns.evaluation import without_nan
from sundae_ns.storage.atomic import write_text
from sundae_ns.storage.run_folder import prunes_before
from sundae_ns.training.extension import TrainingRun


@dataclass(frozen=True)
class PruneReport:
    """Numbers of one prune."""

    step: int
    """Training step after which it happened."""
    before: int
    """Number of primitives before it, including those that are not finite."""
    after: int
    """Number of primitives after it."""
    dropped_nonfinite: int
    """Primitives removed because a parameter was NaN or infinite."""
    peak: int
    """Highest number of primitives at any step so far."""
    seconds: float
    """Wall-clock time of decision and surgery, synchronised."""
    tau: float | None = None
    """Threshold of the graph on squared distances, squared scene units; None without a graph."""
    sigma: float | None = None
    """Width of the edge weights, scene units; None without a graph."""
    isolated: int | None = None
    """Primitives without a neighbour within the threshold; None without a graph."""

    def summary(self) -> str:
        """One line for the log."""
        parts = [f"step {self.step}: kept {self.after:,} of {self.before:,} primitives in {self.seconds:.1f} s"]
        parts.append(f"peak {self.peak:,}")
        if self.dropped_nonfinite:
            parts.append(f"{self.dropped_nonfinite:,} were NaN or infinite")
        if self.sigma is not None and self.tau is not None:
            parts.append(f"sigma {self.sigma:.3g}, tau {self.tau:.3g}, {self.isolated:,} isolated")
        return "; ".join(parts)


def write_record(run: TrainingRun, name: str, record: Mapping[str, Any]) -> None:
    """Write a record as JSON to the run's folder, if there is one; numbers that are not finite become null."""
    if run.folder is not None:
        run.folder.mkdir(parents=True, exist_ok=True)
        write_text(run.folder / name, json.dumps(without_nan(record), indent=2, allow_nan=False) + "\n")


def write_report(
    run: TrainingRun, report: PruneReport, *, before: Mapping[str, float], after: Mapping[str, float]
) -> None:
    """Write a report to the event file and to ``prune.json``.

    Args:
        run: the run.
        report: numbers of the prune.
        before, after: metrics of the test views on both sides of the prune; empty if they were not evaluated.

    Raises:
        StorageError: no space or no right to write.
    """
    scalars = {"before": report.before, "after": report.after, "seconds": report.seconds, "peak": report.peak}
    run.log_scalars("Prune", scalars)
    if run.folder is not None:
        path = run.folder / "prune.json"
        # A run that was killed between a prune and the next save repeats that prune.
        reports = prunes_before(path, report.step)
        reports.append({**asdict(report), "warm_up": dict(before), "pruned": dict(after)})
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(reports, indent=2))
