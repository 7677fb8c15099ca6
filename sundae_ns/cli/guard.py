"""A program that runs a command, and ends it with all that it started once the process that waits for it has died.

It stands between the two in a process group of its own and holds the read end of a pipe as its standard input. The
write end closes when the other process dies, killed or not. :mod:`sundae_ns.cli.process` starts this file as a script,
so it imports nothing of the package.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

PATIENCE = 60
"""Seconds from SIGTERM to SIGKILL, in which a training saves itself."""
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
"""Signals that end a command; Windows lacks SIGHUP, and has SIGBREAK, also for a closed terminal."""
GROUPS = hasattr(os, "killpg")
"""Whether the system has groups of processes. Windows has none: the command alone ends, at once and without saving."""


def guard(words: Sequence[str]) -> int:
    """Run a command without input; returns its exit code, or 128 + n if signal n ended it."""
    # Signals reach the whole group. A handler, not SIG_IGN, which the command would inherit.
    received: list[int] = []
    for name in SIGNALS:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), lambda number, _: received.append(number))
    abandoned = threading.Event()
    if received:
        return 128 + received[0]
    try:
        command = subprocess.Popen(words, stdin=subprocess.DEVNULL)
    except OSError as error:
        print(f"sundae: {words[0]} cannot be started ({error.strerror})", file=sys.stderr)
        return 127

    def watch() -> None:
        os.read(0, 1)  # returns once nobody can write
        abandoned.set()
        if not GROUPS:
            command.terminate()
            return
        os.killpg(0, signal.SIGTERM)
        time.sleep(PATIENCE)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
    code = command.wait()
    if abandoned.is_set() and GROUPS:
        os.killpg(0, signal.SIGKILL)  # what the command has left behind, and this process
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    code = guard(sys.argv[1:])
    sys.stdout.flush()
    os._exit(code)  # without waiting for the thread
