"""Subprocesses whose output goes to a log file."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from sundae_ns.errors import SundaeError

_PERCENT = re.compile(r"^\s*\d+ \(([\d.]+)%\)")
_TAIL = 12


def console_script(name: str) -> str:
    """Path of a command beside this interpreter, or its bare name if there is none."""
    path = Path(sys.executable).parent / name
    return str(path) if path.exists() else name


def run_logged(arguments: Sequence[str], log: Path, on_line: Callable[[str], None] | None = None) -> None:
    """Run a command with its output in ``log``.

    Args:
        arguments: the command; it gets no input.
        log: file for stdout and stderr; an existing file is replaced.
        on_line: called with each line of output.

    Raises:
        SundaeError: the command failed; the message ends with the last lines of its output.
    """
    # With the safe path, `python -m` does not import a sundae_ns from the current folder.
    environment = {**os.environ, "COLUMNS": "160", "PYTHONSAFEPATH": "1"}
    last: deque[str] = deque(maxlen=_TAIL)
    with open(log, "w", encoding="utf-8") as file:
        process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
            errors="replace",
        )
        assert process.stdout is not None
        try:
            for line in process.stdout:
                file.write(line)
                last.append(line.rstrip())
                if on_line is not None:
                    on_line(line)
            code = process.wait()
        except BaseException:  # an interrupt must not leave the process running
            process.terminate()
            process.wait()
            raise
    if code != 0:
        tail = "\n".join(last)
        raise SundaeError(f"{Path(arguments[0]).name} failed with {code}; its log is {log}, which ends with:\n{tail}")


def percent_of(line: str) -> float | None:
    """Progress in per cent from a line of ns-train's output; None if the line has none."""
    found = _PERCENT.match(line)
    return float(found[1]) if found else None
