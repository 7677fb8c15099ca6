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
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from sundae_ns.cli.main import STEP
from sundae_ns.cli.options import progress_bar
from sundae_ns.core.errors import STOPPED, SundaeError, writing

_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_MESSAGES = re.compile(
    r"Warning: |sundae: |Viewer running|Stopping |Left without|trained: |[\d,]+ Gaussians, "
    r"|[\d,]+( of [\d,]+)? steps\s*$|\[[\d:]{8}\] (?!.*\.py:\d+\s*$)|[┏┃┡└]|│ \S"
)
"""Messages of ns-train by this package, and its table of the schedule. Those of nerfstudio end in a line of code."""


def run_command(words: Sequence[str], log: Path | None = None) -> int:
    """Print a command and run it; its exit code. ``log`` takes what ns-train prints, except a bar and messages."""
    print(shlex.join(words), flush=True)
    if log is None:
        return run_logged(words)[0]
    with progress_bar() as bar:
        task = bar.add_task("Training", total=100)

        def show(line: str) -> None:
            line = line.rstrip()
            if share := re.match(r"\s*\d+ \(([\d.]+)%\)", line):
                bar.update(task, completed=float(share[1]), description=" ".join(["Training", *line.split("  ")[-2:]]))
            if _MESSAGES.match(line) or (share and bar.disable):
                print(line, flush=True)

        code, end = run_logged(words, log, show)
    if code and code not in STOPPED and "\nsundae: " not in f"\n{end}":  # else the cause is printed already
        print(end, file=sys.stderr)
    return code


def run_logged(words: Sequence[str], log: Path | None = None, on_line: Callable[[str], Any] = str) -> tuple[int, str]:
    """Run a command without input in its own process group; its exit code, or 128 + n if signal n arrived.

    ``log`` takes stdout and stderr in place of the terminal, and is replaced. ``on_line`` is called with each of its
    lines; the last ones are returned. Ctrl-C, SIGTERM and SIGHUP reach the whole group, once, unless they are ignored;
    SIGHUP as SIGTERM, so that a training saves itself. On Linux the command gets SIGTERM if this process dies.
    """
    # Programs beside this interpreter come first.
    program = shutil.which(words[0], path=str(Path(sys.executable).parent)) or words[0]
    environment = {**os.environ, STEP: "1", "PYTHONWARNINGS": "ignore", **({"COLUMNS": "160"} if log else {})}
    options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "start_new_session": True, "env": environment}
    if log is not None:
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "encoding": "utf-8", "errors": "replace"}
    if sys.platform == "linux":
        prctl = ctypes.CDLL(None).prctl
        options |= {"preexec_fn": lambda: prctl(1, signal.SIGTERM)}  # PR_SET_PDEATHSIG
    last = deque[str](maxlen=12)
    received: list[int] = []

    def pass_on(number: int, frame: object) -> None:
        received.append(signal.SIGINT if number == signal.SIGINT else signal.SIGTERM)
        if hasattr(os, "killpg"):  # a Ctrl-C reaches each process of a Windows console by itself
            with suppress(ProcessLookupError):
                os.killpg(process.pid, received[-1])

    with writing(f"cannot write {log}"), open(log or os.devnull, "w", 1, encoding="utf-8") as file:
        try:
            process = subprocess.Popen([program, *words[1:]], **options)
        except OSError as error:
            raise SundaeError(f"{words[0]} cannot be started ({error.strerror}); run sundae doctor") from error
        before = {each: signal.signal(each, pass_on) for each in _SIGNALS if signal.getsignal(each) != signal.SIG_IGN}
        try:
            for line in process.stdout or ():
                file.write(line)
                last.append(line.rstrip())
                on_line(line)
            code = process.wait()
        except BaseException:  # an error must not leave the process running
            process.terminate()
            process.wait()
            raise
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    code = 128 + received[0] if received else code
    return code if code >= 0 else 128 - code, "\n".join(last)
