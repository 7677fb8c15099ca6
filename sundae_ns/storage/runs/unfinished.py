"""Trainings that ended before their last step."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from sundae_ns.errors import CheckpointError
from sundae_ns.storage.locks import lock
from sundae_ns.storage.runs.checkpoint import newest_step
from sundae_ns.storage.runs.config_file import capture_and_source, schedule_length
from sundae_ns.storage.runs.folder import LOCK


class UnfinishedRun(NamedTuple):
    """A run that can be resumed."""

    folder: Path
    step: int
    """Number of steps that are trained."""
    length: int
    """Number of steps of its schedule."""


def steps_left(run: Path) -> int | None:
    """Number of steps after the newest whole checkpoint of a run; None if there is nothing to resume."""
    try:
        step, length = newest_step(run), schedule_length(run / "config.yml")
    except CheckpointError:
        return None
    return None if step is None else length - step - 1


def unfinished_run(out: Path, method: str, capture: Path) -> UnfinishedRun | None:
    """The newest run of a method on a capture that nobody trains and that no other run has resumed.

    Args:
        out: folder of runs, as of ``ns-train --output-dir``.
        method: name of the method.
        capture: its folder or its ``transforms.json``.
    """
    found: list[tuple[float, UnfinishedRun]] = []
    resumed: set[Path] = set()
    for path in out.glob(f"*/{method}/*/config.yml"):
        folder = path.parent
        try:
            data, source = capture_and_source(path)
        except CheckpointError:
            continue
        if data is None or data.resolve() != capture.resolve():
            continue
        left = steps_left(folder)
        if left is None:
            continue
        if source is not None and source.resolve().parent != folder.resolve():
            resumed.add(source.resolve().parent)
        if left > 0 and not _in_training(folder):
            length = schedule_length(path)
            found.append((path.stat().st_mtime, UnfinishedRun(folder, length - left, length)))
    runs = [run for _, run in sorted(found) if run.folder.resolve() not in resumed]
    return runs[-1] if runs else None


def _in_training(run: Path) -> bool:
    """Whether a process has reserved the folder of a run."""
    try:
        with (run / LOCK).open(encoding="utf-8") as file:
            lock(file, shared=True)
    except BlockingIOError:
        return True
    except OSError:  # no such file, or none that can be locked
        return False
    return False
