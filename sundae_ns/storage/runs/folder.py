"""The folder of a run: its name, who trains in it, where its ``config.yml`` lies, and its records of prunes."""

from __future__ import annotations

import json
import os
import socket
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, TextIO

from sundae_ns.errors import StorageError, regular, writing
from sundae_ns.storage.atomic import write_text
from sundae_ns.storage.locks import lock

LOCK = "training.lock"
"""Names the process that trains in a folder. The file stays; the system drops its lock when the process ends."""
PRUNES, TRIALS, STOPPING = "prune.json", "trials.json", "stopping.json"
"""Records of what a resumed run does not repeat; the watch of the last one follows the decision of the trials."""
_held: dict[Path, TextIO] = {}


def new_name() -> str:
    """A name for a run: the local time to the microsecond."""
    return datetime.now().strftime("%Y-%m-%d_%H%M%S_%f")


def reserve(run: Path, busy: str = "trains in {}; wait for it, or give another --timestamp") -> int:
    """Make a run's folder, reserve it for this process, and remove files that killed processes left unfinished.

    Args:
        run: the folder.
        busy: end of the error message, after the name of the other process; ``{}`` stands for the folder.

    Returns:
        Descriptor of the locked file. The lock lasts while a process has it open.

    Raises:
        StorageError: another process has reserved it, or the folder cannot be written.
    """
    run = run.resolve()
    if run in _held:
        return _held[run].fileno()
    with writing(f"cannot write to the run's folder {run}"):
        run.mkdir(parents=True, exist_ok=True)
        file = (run / LOCK).open("a+", encoding="utf-8")
        try:
            lock(file)
        except BlockingIOError as error:
            file.seek(0)
            holder = file.read().strip() or "another process"
            raise StorageError(f"{holder} {busy.format(run)}") from error
        file.truncate(0)
        print(f"process {os.getpid()} on {socket.gethostname()}", file=file, flush=True)
    _held[run] = file
    for unfinished in [*run.glob("*.partial"), *run.glob("*/partial--1.*")]:
        with suppress(OSError):
            unfinished.unlink()
    return file.fileno()


def prunes_before(path: Path, step: int) -> list[dict[str, Any]]:
    """Records of a ``prune.json`` before a step; empty without such a file.

    A file that cannot be read is renamed to ``*.damaged.json``, because it should not end a training.
    """
    try:
        return [record for record in _records(path) if record["step"] < step]
    except FileNotFoundError:
        pass
    except (ValueError, TypeError, KeyError):
        path.replace(path.with_suffix(".damaged.json"))
    return []


def take_records(source: Path, run: Path, step: int) -> None:
    """Copy the records of a run to the folder of another that resumes it after a step, but those of later steps.

    Args:
        source: folder of the run that is resumed. Its damaged records are passed over.
        run: folder of the other; a record that it has is kept.
        step: step of the checkpoint, in steps of one image.

    Raises:
        StorageError: no space or no right to write.
    """
    prunes = prunes_of(source)
    before = [record for record in prunes if isinstance(record.get("step"), int) and record["step"] <= step]
    if before and not (run / PRUNES).exists():
        write_text(run / PRUNES, json.dumps(before, indent=2))
    with suppress(OSError, ValueError, AttributeError, TypeError):
        decided = json.loads(regular(source / TRIALS).read_text(encoding="utf-8")).get("step", step) <= step
        for name in (TRIALS, STOPPING) if decided else ():
            if (source / name).is_file() and not (run / name).exists():
                write_text(run / name, (source / name).read_text(encoding="utf-8"))


def prunes_of(run: Path) -> list[dict[str, Any]]:
    """Records of the prunes of a finished run, given its folder; empty if they cannot be read."""
    try:
        return _records(run / PRUNES)
    except (OSError, ValueError):
        return []


def _records(path: Path) -> list[dict[str, Any]]:
    records = json.loads(regular(path).read_text(encoding="utf-8"))
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise ValueError(f"{path} is no list of objects")
    return records


def config_of(run: Path) -> Path:
    """Path of the ``config.yml`` of a run, given its folder or that file; it need not exist."""
    return run / "config.yml" if run.is_dir() else run


def files_of(run: Path) -> list[Path]:
    """Files and folders of a run that commands read, given its folder or its ``config.yml``; another file itself."""
    if run.is_file() and run.name != "config.yml":
        return [run]
    folder = config_of(run).parent
    names = ("config.yml", "nerfstudio_models", "dataparser_transforms.json", "start.json", PRUNES)
    return [folder / name for name in names]


def find_config(path: Path) -> Path | None:
    """The ``config.yml`` of a run, given it, the run's folder, the folder of its checkpoints, or one of these."""
    folder = path if path.is_dir() else path.parent
    places = [folder, folder.parent] if folder.name == "nerfstudio_models" else [folder]
    return next((place / "config.yml" for place in places if (place / "config.yml").is_file()), None)
