"""Finished runs as rows of a CSV file such as ``benchmarks/results/runs.csv``."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

from sundae_ns.errors import DataError

with contextlib.suppress(ImportError):  # Windows has none.
    import fcntl


@dataclass(frozen=True, kw_only=True)
class RunRow:
    """One run. The fields are the columns, in order; None is an empty cell and means not measured.

    Metrics are means over all test views; ``psnr_base`` and ``ssim_base`` are without the head. ``bytes_*`` are in bytes,
    ``ms_*`` in milliseconds per frame, ``train_s`` and ``prune_s`` in seconds.
    """

    scene: str
    method: str
    variant: str
    keep_ratio: float | None
    seed: int | None
    steps: int
    primitives: int
    psnr: float | None
    ssim: float | None
    psnr_base: float | None
    ssim_base: float | None
    lpips: float | None = None
    lpips_net: str = ""
    bytes_primitives: int
    bytes_head: int
    bytes_total: int
    ms_frame: float | None = None
    ms_splat: float | None = None
    ms_head: float | None = None
    train_s: float | None
    prune_s: float | None = None
    peak_primitives: int | None = None
    """Peak number of primitives during training, including between growing and culling."""
    peak_vram_mib: float | None = None
    """Peak GPU memory allocated by torch during training, MiB."""
    gpu: str
    resolution: str
    """Width x height of the images in pixels: ``1237x822``."""
    commit: str
    command: str


COLUMNS = tuple(field.name for field in fields(RunRow))
_TYPES = get_type_hints(RunRow)


def _line(cells: list[str]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)
    return buffer.getvalue()


def _cell(value: object) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    # One line per row makes an append a single write and a git diff readable.
    return " ".join(str(value).split())


def _cells(row: RunRow) -> list[str]:
    return [_cell(getattr(row, name)) for name in COLUMNS]


def _parse(name: str, text: str) -> Any:
    kind = _TYPES[name]
    if kind is str:
        return text
    if kind is int:
        return int(text)
    if kind == (int | None):
        return int(text) if text else None
    return float(text) if text else None


def _check_header(path: Path, header: list[str]) -> None:
    if tuple(header) == COLUMNS:
        return
    odd = sorted(set(header) ^ set(COLUMNS)) or ["their order"]
    raise DataError(f"{path} has other columns (different: {', '.join(odd)}); name another file.")


def csv_text(rows: Sequence[RunRow]) -> str:
    """Runs as CSV with a header."""
    return "".join(_line(cells) for cells in (list(COLUMNS), *map(_cells, rows)))


def append_row(path: Path, row: RunRow) -> None:
    """Append a run to a CSV file; a missing file is created with its header.

    The row is appended in one write, so a crash cannot leave half a row. The file is locked meanwhile where the system has
    ``flock``, so appends of several processes wait for each other.

    Args:
        path: the file; missing folders are created.
        row: the run; NaN is written as an empty cell.

    Raises:
        DataError: the file has other columns, or cannot be written.
    """
    path = Path(path)
    line = _line(_cells(row))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b") as file:
            wait_for_lock(file.fileno())
            file.seek(0)
            if first := file.readline().decode("utf-8", errors="replace"):
                _check_header(path, next(csv.reader([first])))
                file.seek(-1, os.SEEK_END)
                # An editor may have removed the last newline.
                line = line if file.read(1) == b"\n" else "\n" + line
            else:
                line = _line(list(COLUMNS)) + line
            file.write(line.encode("utf-8"))
    except OSError as error:
        raise DataError(f"{path} cannot be written ({error.strerror}); name another file.") from error


def wait_for_lock(descriptor: int) -> None:
    """Wait for the lock of an open file, and hold it until the file is closed; no lock where ``flock`` is missing (Windows)."""
    if os.name == "posix":
        fcntl.flock(descriptor, fcntl.LOCK_EX)


def read_rows(path: Path) -> list[RunRow]:
    """Read all runs of a CSV file; the inverse of :func:`append_row`.

    Raises:
        DataError: the file is missing, has other columns, or a row does not fit them.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.reader(file))
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); check the path.") from error
    _check_header(path, lines[0] if lines else [])
    rows = []
    for number, cells in enumerate(lines[1:], start=2):
        try:
            rows.append(RunRow(**{name: _parse(name, text) for name, text in zip(COLUMNS, cells, strict=True)}))
        except ValueError as error:
            raise DataError(f"{path}, row {number} does not fit the columns ({error}); fix or remove it.") from error
    return rows
