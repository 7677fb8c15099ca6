"""Rows of ``benchmarks/results/runs.csv``: one finished run each."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

from sundae_ns.errors import DataError

with contextlib.suppress(ImportError):  # Windows has none.
    import fcntl


@dataclass(frozen=True, kw_only=True)
class RunRow:
    """One run. The fields are the columns, in order; None, an empty cell, is what was not measured.

    Metrics are means over all test views. ``psnr_base`` and ``ssim_base`` are of the base colours, without the head.
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
    """Most primitives at any time during training, between growing and culling too."""
    peak_vram_mib: float | None = None
    """Most memory that torch held on the GPU during training."""
    gpu: str
    resolution: str
    """Width x height of the pictures, pixels: ``1237x822``."""
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
    # One line a row: it is what makes an append one write, and a difference in git readable.
    return " ".join(str(value).split())


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


def append_row(path: Path, row: RunRow) -> None:
    """Append a run to a CSV file, which is created with its header where there is none.

    The line goes out in one write to the file's end, so that a crash cannot leave half a row; the file is locked
    meanwhile (where the system has ``flock``), so that appends of several processes wait for each other.

    Args:
        path: the file; missing folders are created.
        row: the run; NaN is written as not measured.

    Raises:
        DataError: the file has other columns, or cannot be written.
    """
    path = Path(path)
    line = _line([_cell(getattr(row, name)) for name in COLUMNS])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b") as file:
            wait_for_lock(file.fileno())
            file.seek(0)
            if first := file.readline().decode("utf-8", errors="replace"):
                _check_header(path, next(csv.reader([first])))
                file.seek(-1, os.SEEK_END)
                # An editor may have dropped the last line's end.
                line = line if file.read(1) == b"\n" else "\n" + line
            else:
                line = _line(list(COLUMNS)) + line
            file.write(line.encode("utf-8"))
    except OSError as error:
        raise DataError(f"{path} cannot be written ({error.strerror}); name another file.") from error


def wait_for_lock(descriptor: int) -> None:
    """Wait for a file's lock, which goes with the descriptor; nothing where the system has no ``flock`` (Windows)."""
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
            raise DataError(f"{path}, row {number} does not fit the columns ({error}); mend or remove it.") from error
    return rows
