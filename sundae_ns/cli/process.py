"""A spinner while a command loads, and subprocesses: logged, or in a process group that gets this one's signals."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from sundae_ns.cli import guard
from sundae_ns.errors import SundaeError

GUARD = Path(guard.__file__)
"""Script between a command and this process; see :mod:`sundae_ns.cli.guard`."""

_PERCENT = re.compile(r"^\s*\d+ \(([\d.]+)%\)")
_TAIL = 12


def console_script(name: str) -> str:
    """Path of a command beside this interpreter, or its bare name if there is none."""
    return shutil.which(name, path=str(Path(sys.executable).parent)) or name  # on Windows, name.exe


def loading() -> AbstractContextManager[object]:
    """Shows that a command imports its modules, which takes seconds."""
    from rich.console import Console

    return Console(stderr=True).status("Loading")


def word(path: Path) -> str:
    """A path as a word of a command; one that begins with a dash would be taken for an option."""
    return f".{os.sep}{path}" if str(path).startswith("-") else str(path)


def quoted(path: Path) -> str:
    """A path as a word of a command that a user copies into a shell."""
    return shlex.quote(word(path)) if os.name == "posix" else subprocess.list2cmdline([word(path)])


@contextmanager
def _started(words: Sequence[str], *, locks: Sequence[int] = (), **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """Start a command without input in a process group of its own, which ends if this process dies.

    Args:
        words: the command; its program is looked for beside this interpreter first.
        locks: descriptors of locked files, which stay locked until the group has ended.
        options: of ``subprocess.Popen``.
    """
    guarded = [sys.executable, "-I", str(GUARD), console_script(words[0]), *words[1:]]
    if guard.GROUPS:
        options |= {"start_new_session": True, "pass_fds": locks}
    with subprocess.Popen(guarded, stdin=subprocess.PIPE, **options) as process:
        yield process


def _send(process: subprocess.Popen[Any], number: int) -> None:
    """Send a signal to the group of a command.

    Without groups nothing is sent: a terminal's Ctrl-C reaches each process of a Windows console by itself.
    """
    if guard.GROUPS:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)


def run_logged(arguments: Sequence[str], log: Path, on_line: Callable[[str], None] | None = None) -> None:
    """Run a command with its output in ``log``.

    Args:
        arguments: the command; it gets no input.
        log: file for stdout and stderr; an existing file is replaced.
        on_line: called with each line of output.

    Raises:
        SundaeError: the command failed; the message ends with the last lines of its output.
    """
    last: deque[str] = deque(maxlen=_TAIL)
    environment = {**os.environ, "COLUMNS": "160", "PYTHONUTF8": "1"}  # Windows has another encoding by default
    output: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    output |= {"encoding": "utf-8", "errors": "replace"}
    with (
        open(log, "w", encoding="utf-8") as file,
        _started(arguments, env=environment, **output) as process,
    ):
        assert process.stdout is not None
        try:
            for line in process.stdout:
                file.write(line)
                last.append(line.rstrip())
                if on_line is not None:
                    on_line(line)
            code = process.wait()
        except BaseException:  # an interrupt must not leave the process running
            if guard.GROUPS:
                _send(process, signal.SIGTERM)
            elif process.stdin is not None:
                process.stdin.close()  # the guard takes this process for dead, and ends the command
            process.wait()
            raise
    if code != 0:
        tail = "\n".join(last)
        raise SundaeError(f"{Path(arguments[0]).name} failed with {code}; its log is {log}, which ends with:\n{tail}")


def run_in_group(words: Sequence[str], *, locks: Sequence[int] = (), saves: bool = True) -> int:
    """Run a command with its output on the terminal; returns its exit code, or 128 + n if signal n arrived.

    A signal reaches the command once, with all processes that it started, whether it comes from a terminal or from
    another process. If this process is killed, the command gets SIGTERM, and SIGKILL after :data:`guard.PATIENCE`.

    Args:
        words: the command; it gets no input. Its program is looked for beside this interpreter first.
        locks: descriptors of locked files, which stay locked until the command has ended.
        saves: whether an interrupt makes the command save its work. Others end by SIGTERM in its place, because each of
            their processes would print a traceback.
    """
    # A training that loses its terminal saves itself too.
    interrupt = signal.SIGINT if saves else signal.SIGTERM
    caught = [signal.Signals[name] for name in guard.SIGNALS if name in signal.Signals.__members__]
    passed_on = {number: interrupt if number == signal.SIGINT else signal.SIGTERM for number in caught}
    received: list[signal.Signals] = []
    running: list[subprocess.Popen[Any]] = []

    def pass_on(number: int, frame: object) -> None:
        received.append(signal.Signals(number))
        for process in running:
            _send(process, passed_on[received[-1]])

    before = {number: signal.signal(number, pass_on) for number in passed_on}
    try:
        with _started(words, locks=locks) as process:
            running.append(process)
            for number in received:  # those that came before there was a process
                _send(process, passed_on[number])
            code = process.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if received:
        if not saves and sys.stderr.isatty():
            sys.stderr.write("\x1b[?25h")  # the cursor, which a spinner hides
        return 128 + (signal.SIGINT if received[0] == signal.SIGINT else signal.SIGTERM)
    return code if code >= 0 else 128 - code


def percent_of(line: str) -> float | None:
    """Progress in per cent from a line of ns-train's output; None if the line has none."""
    found = _PERCENT.match(line)
    return float(found[1]) if found else None
