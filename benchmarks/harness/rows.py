"""Tables of results as CSV files, in which a row takes the place of an earlier one of the same thing."""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sundae_ns.core.files import replacing


def read_rows(path: Path | None) -> list[dict[str, Any]]:
    """The rows of a table; none if there is none yet."""
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines())) if path and path.exists() else []


class Rows:
    """The rows of a file, which the columns of ``place`` tell apart; without a file they are only printed."""

    def __init__(self, path: Path | None, columns: Sequence[str], place: Sequence[str]) -> None:
        self.path, self.columns, self.place, self.rows = path, columns, place, read_rows(path)
        self._printed = csv.DictWriter(sys.stdout, columns, lineterminator="\n")
        self._printed.writeheader()

    def place_of(self, row: Mapping[str, Any]) -> tuple[str, ...]:
        """What a row is of: another version of a program takes the place of an earlier one."""
        return tuple(str(row[name]).split(" ")[0] if name == "program" else str(row[name]) for name in self.place)

    def __contains__(self, row: Mapping[str, Any]) -> bool:
        return self.place_of(row) in map(self.place_of, self.rows)

    def put(self, row: dict[str, Any]) -> None:
        """Print a row, and replace the file by one that has it."""
        self.rows = [other for other in self.rows if self.place_of(other) != self.place_of(row)] + [row]
        self._printed.writerow(row)
        sys.stdout.flush()
        if self.path is not None:
            with replacing(self.path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, self.columns, lineterminator="\n")
                writer.writeheader()
                writer.writerows(self.rows)
