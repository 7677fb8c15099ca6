"""Commands run as processes of their own, their output kept in a file."""

from __future__ import annotations

import os
import re
import subprocess
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from sundae_ns.errors import SundaeError

_PERCENT = re.compile(r"^\s*\d+ \(([\d.]+)%\)")
_TAIL = 12


def run_logged(arguments: Sequence[str], log: Path, on_line: Callable[[str], None] | None = None) -> None:
    """Run a command with its output in ``log``.

    Args:
        arguments: the command; it gets no input.
        log: file for its output, stderr included; an earlier one is replaced.
        on_line: called with each line of output.

    Raises:
        SundaeError: it failed; the message shows the end of its output.
    """
    # Safe path: `python -m` would look in the current folder first, where another sundae_ns may lie.
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
        except BaseException:  # above all an interrupt, which should not leave it behind
            process.terminate()
            process.wait()
            raise
    if code != 0:
        tail = "\n".join(last)
        raise SundaeError(
            f"{Path(arguments[0]).name} failed with {code}; its whole output is in {log}, it ended so:\n{tail}"
        )


def percent_of(line: str) -> float | None:
    """How far a training run says that it is, in per cent, if this line of its output says so."""
    found = _PERCENT.match(line)
    return float(found[1]) if found else None
