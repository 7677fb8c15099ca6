"""What a training and the terminal tell each other: messages, time left, and signals that stop a run."""

from __future__ import annotations

import argparse
import logging
import math
import os
import shlex
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.console import Console


class ConsoleHandler(logging.Handler):
    """Prints messages with their time, and warnings in yellow; no markup, because names of files may hold brackets."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message."""
        warns = record.levelno >= logging.WARNING
        text = f"{'Warning:' if warns else time.strftime('[%H:%M:%S]')} {self.format(record)}"
        Console(width=120).print(text, style="yellow" if warns else None, markup=False, soft_wrap=True)


def show_log() -> None:
    """Show the log of the package on the console. The shell of a command asks for it, a library does not."""
    log = logging.getLogger("sundae_ns")
    if not any(isinstance(handler, ConsoleHandler) for handler in log.handlers):
        log.addHandler(ConsoleHandler())
        log.setLevel(logging.INFO)


LONG = 1800.0  # Seconds of a training on a CPU that are worth a warning


def duration(seconds: float) -> str:
    """A duration in two units at most: ``1 h 5 min``, ``2 min``, ``40 s``."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


class TimeLeft:
    """Smooths the time of a step: evaluations, saves and a busy machine change it by the minute.

    Steps of the last :data:`SHARE` of a run count the most. One counts :data:`MOST` times the usual one at most.
    """

    SHARE = 0.1
    MOST = 3.0

    def __init__(self) -> None:
        self.step_s: float | None = None  # Of a step; None before the second line, as the first step also compiles
        self._at: tuple[int, float] | None = None
        self._steps = 0.0

    def update(self, done: int, total: int, now: float) -> float | None:
        """Seconds left after ``done`` of ``total`` steps at the time ``now``; None if it is not known yet."""
        before, self._at = self._at, (done, now)
        if before is not None and done > before[0]:
            steps = done - before[0]
            step_s = (now - before[1]) / steps
            usual = step_s if self.step_s is None else self.step_s
            step_s = min(max(step_s, usual / self.MOST), usual * self.MOST)
            weight = self._steps * math.exp(-steps / max(self.SHARE * total, 1))
            self.step_s = (weight * usual + steps * step_s) / (weight + steps)
            self._steps = weight + steps
        return None if self.step_s is None else (total - done) * self.step_s


def long_on_cpu(seconds: float, left: int) -> str | None:
    """A warning if a training on a CPU takes more than half an hour; None otherwise.

    The seconds are of one of the first steps, which use smaller images and fewer Gaussians than the ``left`` ones.
    """
    least = f"this training runs on a CPU and takes at least {duration(seconds * left)} more"
    smaller = "smaller images are faster: end the command with nerfstudio-data --downscale-factor 4"
    ways = f"sundae-tiny is made for a CPU, --max-num-iterations shortens the whole schedule, and {smaller}"
    return None if seconds * left <= LONG else f"{least} ({1000 * seconds:.0f} ms a step). {ways}"


COMMANDS = ("ns-eval", "ns-render", "ns-export", "ns-viewer")  # They only read the run of --load-config


def loaded_run(program: Sequence[str]) -> Path | None:
    """Folder of the run that a command (as in ``sys.argv``) opens by its ``config.yml``; None for other commands."""
    if not program or Path(program[0]).stem not in COMMANDS:
        return None
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--load-config", "--load_config", nargs="?")
    config = Path(parser.parse_known_args(program[1:])[0].load_config or "")
    return config.absolute().parent if config.is_file() else None


STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_REPLACED = ("load_dir", "load_step", "load_checkpoint", "max_num_iterations", "schedule_length")


class Interruption:
    """While it is entered, the first signal calls ``ask``, and a second SIGINT leaves at once; in the main thread only.

    It says nothing if it is ``quiet``, as another process does.
    """

    def __init__(self, ask: Callable[[], None], *, quiet: bool = False) -> None:
        self.number = 0  # The first signal; 0 for none
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

    def _handle(self, number: int, frame: object) -> None:
        if self.number == 0:
            self.number = number
            self._say("\nStopping after this step, to save a checkpoint; Ctrl-C again leaves at once.\n")
            self._ask()
        elif number == signal.SIGINT:
            self._say("\nLeft without saving; older checkpoints are whole.\n")
            os._exit(128 + number)

    def _say(self, text: str) -> None:
        with suppress(OSError):  # who read it may have been killed
            os.write(2, b"" if self._quiet else text.encode())  # a handler may interrupt a print


def resume_command(program: Sequence[str], folder: Path, method: str, data: object, left: int) -> str:
    """The command that trains the ``left`` steps of the run whose checkpoints lie in a folder.

    It follows the command line that started the run, if that was ``ns-train``'s. Steps that it stated may be fewer than
    the schedule has; else the schedule says how many are left.
    """
    if Path(program[0]).name != "ns-train" or len(program) < 2:
        return shlex.join(["ns-train", method, "--data", str(data), "--load-dir", str(folder)])
    words, length, skip = [], list[str](), False
    for word in program[2:]:
        option = word[2:].partition("=")[0].replace("-", "_") if word.startswith("--") else None
        if option in _REPLACED:
            skip = "=" not in word
            length = ["--max-num-iterations", str(left)] if option == "max_num_iterations" else length
        elif skip:
            skip = False
        else:
            words.append(word)
    # Before the rest, which may end in a subcommand of the data parser.
    return shlex.join(["ns-train", program[1], "--load-dir", str(folder), *length, *words])
