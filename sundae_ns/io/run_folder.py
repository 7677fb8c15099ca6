"""The folder of a run: its name, the process that trains in it, its records of prunes, and runs that ended early.

config.yml           options, as nerfstudio saves them (:mod:`sundae_ns.io.config_file`)
nerfstudio_models/   checkpoints (:mod:`sundae_ns.io.checkpoint`)
prune.json           a list with an object for each prune
trials.json          what the trials decided
training.lock        names the process that trains here, which holds its lock
"""

from __future__ import annotations

import json
import logging
import os
import socket
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, TextIO

from sundae_ns.core.errors import CheckpointError, StorageError, regular, writing
from sundae_ns.core.files import locked, write_text
from sundae_ns.io.checkpoint import newest_step
from sundae_ns.io.config_file import capture_and_source, config_of, schedule_length

FRAME_FILE = "dataparser_transforms.json"  # of nerfstudio
LOCK = "training.lock"
PRUNES = "prune.json"  # record of the prunes, which a resumed run does not repeat
_log = logging.getLogger(__name__)
_held: dict[Path, TextIO] = {}


def new_name() -> str:
    """A name for a run: the local time to the microsecond."""
    return datetime.now().strftime("%Y-%m-%d_%H%M%S_%f")


def files_of(run: Path) -> list[Path]:
    """Files and folders of a run that commands read, given its folder or its ``config.yml``; another file itself."""
    if run.is_file() and run.name != "config.yml":
        return [run]
    folder = config_of(run).parent
    return [folder / name for name in ("config.yml", "nerfstudio_models", FRAME_FILE, PRUNES)]


def reserve(run: Path, busy: str = "trains in {}; wait for it, or give another --timestamp") -> int:
    """Make a run's folder, reserve it for this process, and remove files that killed processes left unfinished.

    Returns the descriptor of the locked file; the lock lasts while a process has it open. ``StorageError`` if another
    process, whose name stands before the words ``busy``, has reserved the folder ``{}``, or it cannot be written.
    """
    if (run := run.resolve()) in _held:
        return _held[run].fileno()
    with writing(f"cannot write to the run's folder {run}"):
        run.mkdir(parents=True, exist_ok=True)
        file = (run / LOCK).open("a+", encoding="utf-8")
        if locked(file) is False:
            file.seek(0)
            holder = file.read().strip() or "another process"
            file.close()
            raise StorageError(f"{holder} {busy.format(run)}")
        file.truncate(0)
        print(f"process {os.getpid()} on {socket.gethostname()}", file=file, flush=True)
    _held[run] = file
    for unfinished in [*run.glob("*.partial"), *run.glob("*/partial--1.*")]:
        with suppress(OSError):
            unfinished.unlink()
    return file.fileno()


def _in_training(run: Path) -> bool:
    """Whether a process has reserved the folder of a run."""
    with suppress(OSError), (run / LOCK).open(encoding="utf-8") as file:
        return locked(file) is False
    return False


def prunes_of(run: Path) -> list[dict[str, Any]]:
    """Records of the prunes of a run, given its folder; empty if they cannot be read."""
    try:
        records = json.loads(regular(run / PRUNES).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return []
    return records if isinstance(records, list) and all(isinstance(record, dict) for record in records) else []


def prunes_before(path: Path, step: int) -> list[dict[str, Any]]:
    """Records of a ``prune.json`` before a step; empty without such a file.

    A file that cannot be read is renamed to ``*.damaged.json``, because it should not end a training.
    """
    try:
        with suppress(FileNotFoundError):
            return [record for record in json.loads(regular(path).read_text(encoding="utf-8")) if record["step"] < step]
    except (ValueError, TypeError, KeyError, RecursionError):
        path.replace(path.with_suffix(".damaged.json"))
    return []


def take_records(source: Path, run: Path, step: int) -> None:
    """Copy the records of a run's prunes up to a ``step`` to the folder of another run that resumes it there.

    Damaged records are passed over; a record that the other run has is kept. ``StorageError`` without space or rights.
    """
    before = [prune for prune in prunes_of(source) if isinstance(prune.get("step"), int) and prune["step"] <= step]
    if before and not (run / PRUNES).exists():
        write_text(run / PRUNES, json.dumps(before, indent=2))


def steps_left(run: Path) -> int | None:
    """Number of steps after the newest whole checkpoint of a run; None if there is nothing to resume."""
    try:
        step, length = newest_step(run), schedule_length(run / "config.yml")
    except CheckpointError:
        return None
    return None if step is None else length - step - 1


def unfinished_run(out: Path, method: str, capture: Path) -> tuple[Path, int, int] | None:
    """The newest run of a method on a capture that nobody trains and that no other run has resumed.

    ``out`` is the folder of runs, as of ``ns-train --output-dir``; ``capture`` a folder or its ``transforms.json``.
    Returns the run's folder, the number of its steps, and that of its schedule's.
    """
    candidates: list[tuple[float, tuple[Path, int, int]]] = []
    resumed: set[Path] = set()
    for path in out.glob(f"*/{method}/*/config.yml"):
        folder = path.parent
        try:
            data, source = capture_and_source(path)
        except CheckpointError:
            continue
        if data is None or data.resolve() != capture.resolve() or (left := steps_left(folder)) is None:
            continue
        if source is not None and source.resolve().parent != folder.resolve():
            resumed.add(source.resolve().parent)
        if left > 0 and not _in_training(folder):
            length = schedule_length(path)
            candidates.append((path.stat().st_mtime, (folder, length - left, length)))
    runs = [run for _, run in sorted(candidates) if run[0].resolve() not in resumed]
    if len(runs) > 1:  # a clock that was wrong tells the order wrongly
        which = f"{runs[-1][0]} is the newest of {len(runs)} unfinished runs by their dates"
        _log.warning("%s; to resume another, add -- --load-dir RUN/nerfstudio_models", which)
    return runs[-1] if runs else None
