"""Rows of ``report.csv`` and ``results.csv``."""

from __future__ import annotations

import csv
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any


def read_rows(path: Path) -> list[SimpleNamespace]:
    """Rows as objects: numbers as numbers, an empty cell as None."""
    with path.open(newline="", encoding="utf-8") as file:
        return [SimpleNamespace(**{name: _value(cell) for name, cell in row.items()}) for row in csv.DictReader(file)]


def _value(cell: str) -> Any:
    for kind in (int, float):
        with suppress(ValueError):
            return kind(cell)
    return cell or None
