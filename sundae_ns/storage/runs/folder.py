"""The folder of a run: where its ``config.yml`` lies, and its records of prunes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def prunes_before(path: Path, step: int) -> list[dict[str, Any]]:
    """Records of a ``prune.json`` before a step; empty without such a file.

    A file that cannot be read is renamed to ``*.damaged.json``, because it should not end a training.
    """
    try:
        records = json.loads(path.read_text(encoding="utf-8"))
        return [record for record in records if record["step"] < step]
    except FileNotFoundError:
        return []
    except (ValueError, TypeError, KeyError):
        path.replace(path.with_suffix(".damaged.json"))
        return []


def prunes_of(run: Path) -> list[dict[str, Any]]:
    """Records of the prunes of a finished run; empty if there are none that can be read.

    Args:
        run: folder of the run.
    """
    try:
        records = json.loads((run / "prune.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    known = isinstance(records, list) and all(isinstance(record, dict) for record in records)
    return records if known else []


def config_of(run: Path) -> Path:
    """Path of the ``config.yml`` of a run, given its folder or that file; it need not exist."""
    return run / "config.yml" if run.is_dir() else run


def find_config(path: Path) -> Path | None:
    """The ``config.yml`` of the run that a path belongs to: the file, the run's folder, its checkpoints or one of them."""
    if path.name == "config.yml" and path.is_file():
        return path
    folder = path if path.is_dir() else path.parent
    places = [folder, folder.parent] if folder.name == "nerfstudio_models" else [folder]
    return next((place / "config.yml" for place in places if (place / "config.yml").is_file()), None)
