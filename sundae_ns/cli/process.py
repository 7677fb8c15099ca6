"""Commands that a command starts: they end with it, get its signals, and write to the terminal or into a log."""

from __future__ import annotations

import ctypes
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sundae_ns.core.errors import SundaeError

_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


def word(path: Path) -> str:
    """A path as a word of a command; one that begins with a dash would be taken for an option."""
    return f".{os.sep}{path}" if str(path).startswith("-") else str(path)


def quoted(path: Path) -> str:
    """A path as a word of a command that a user copies into a shell."""
    return shlex.quote(word(path))


@contextmanager
def _started(words: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """Start a command without input in its own process group; on Linux it gets SIGTERM if this process dies."""
    # Programs beside this interpreter come first.
    program = shutil.which(words[0], path=str(Path(sys.executable).parent)) or words[0]
    options |= {"stdin": subprocess.DEVNULL, "start_new_session": True}
    if sys.platform == "linux":
        prctl = ctypes.CDLL(None).prctl
        options |= {"preexec_fn": lambda: prctl(1, signal.SIGTERM)}  # PR_SET_PDEATHSIG
    try:
        process = subprocess.Popen([program, *words[1:]], **options)
    except OSError as error:
        raise SundaeError(f"{words[0]} cannot be started ({error.strerror}); sundae doctor checks the setup") from error
    with process:
        yield process


def run_command(words: Sequence[str]) -> int:
    """Print a command and run it on the terminal; returns its exit code, or 128 + n if signal n arrived.

    Ctrl-C, SIGTERM and SIGHUP reach the command and all processes that it started, once; SIGHUP as SIGTERM, so that a
    training that loses its terminal saves itself.
    """
    print(shlex.join(words), flush=True)
    received: list[int] = []
    with _started(words) as process:

        def pass_on(number: int, frame: object) -> None:
            received.append(signal.SIGINT if number == signal.SIGINT else signal.SIGTERM)
            if hasattr(os, "killpg"):  # a Ctrl-C reaches each process of a Windows console by itself
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, received[-1])

        before = {number: signal.signal(number, pass_on) for number in _SIGNALS}
        try:
            code = process.wait()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    if received:
        return 128 + received[0]
    return code if code >= 0 else 128 - code


def run_logged(words: Sequence[str], log: Path, on_line: Callable[[str], object] = lambda line: None) -> None:
    """Run a command with stdout and stderr in ``log``, which is replaced; ``on_line`` is called with each line.

    Raises:
        SundaeError: the command failed; the message ends with the last lines of its output.
    """
    last: deque[str] = deque(maxlen=12)
    output: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "encoding": "utf-8"}
    output |= {"errors": "replace", "env": {**os.environ, "COLUMNS": "160"}}
    with open(log, "w", encoding="utf-8") as file, _started(words, **output) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                file.write(line)
                last.append(line.rstrip())
                on_line(line)
        except BaseException:  # an interrupt must not leave the process running
            process.terminate()
            raise
    if process.returncode:
        end = "\n".join(last)
        raise SundaeError(f"{Path(words[0]).name} failed with {process.returncode}; {log} ends with:\n{end}")


def percent_of(line: str) -> float | None:
    """Progress in per cent from a line of ns-train's output; None if the line has none."""
    match = re.match(r"^\s*\d+ \(([\d.]+)%\)", line)
    return float(match[1]) if match else None
