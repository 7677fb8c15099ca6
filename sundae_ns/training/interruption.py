"""SIGINT and SIGTERM while training: the run is saved after the step, and ends with the command that resumes it."""

from __future__ import annotations

import os
import shlex
import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_REPLACED = ("load_dir", "load_step", "load_checkpoint", "max_num_iterations", "schedule_length")


class Interruption:
    """While it is entered, the first signal is noted, and a second SIGINT leaves at once. Other threads are left alone.

    Args:
        ask: called at the first signal, in the signal handler.
        quiet: whether another process says what happens.
    """

    def __init__(self, ask: Callable[[], None], *, quiet: bool = False) -> None:
        self.number = 0
        """The first signal; 0 for none."""
        self._ask, self._quiet = ask, quiet
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._handle) for number in STOP_SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self.restore()

    def restore(self) -> None:
        """Give the signals back to whoever had them before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.number == 0:
            self.number = number
            self._say("\nStopping after this step, to save a checkpoint; Ctrl-C again leaves at once.\n")
            self._ask()
        elif number == signal.SIGINT:
            self._say("\nLeft without saving; older checkpoints are whole.\n")
            os._exit(128 + number)

    def _say(self, text: str) -> None:
        if not self._quiet:
            os.write(2, text.encode())  # a handler may interrupt a print


def resume_command(program: Sequence[str], folder: Path, method: str, data: object) -> str:
    """The command that trains the remaining steps of a run.

    Args:
        program: the command line that started the run; if it is not ``ns-train``'s, one is made from the others.
        folder: the run's checkpoints.
        method: its method.
        data: the capture.
    """
    if Path(program[0]).name != "ns-train" or len(program) < 2:
        return shlex.join(["ns-train", method, "--data", str(data), "--load-dir", str(folder)])
    words, skip = [], False
    for word in program[2:]:
        option = word[2:].partition("=")[0].replace("-", "_") if word.startswith("--") else None
        if option in _REPLACED:
            skip = "=" not in word
        elif skip:
            skip = False
        else:
            words.append(word)
    # Before the rest, which may end in a subcommand of the data parser.
    return shlex.join(["ns-train", program[1], "--load-dir", str(folder), *words])
