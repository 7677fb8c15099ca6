"""Commands in a process group: exit codes, and signals that reach them and what they started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from sundae_ns.cli.process import run_in_group

CHILD = """
import pathlib, signal, subprocess, sys
here = pathlib.Path(sys.argv[1])
grandchild = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
(here / "grandchild").write_text(str(grandchild.pid))

def stop(number, frame):
    with (here / "signals").open("a") as file:
        print(number, file=file)
    sys.exit(0)

for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, stop)
(here / "ready").touch()
signal.pause()
"""


@pytest.mark.parametrize(("code", "expected"), [("pass", 0), ("raise SystemExit(7)", 7)])
def test_the_exit_code_is_the_command_s(code: str, expected: int) -> None:
    assert run_in_group([sys.executable, "-c", code]) == expected


def test_a_command_that_a_signal_ended() -> None:
    assert run_in_group([sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"]) == 137


@pytest.mark.parametrize(
    ("sent", "passed_on"),
    [(signal.SIGINT, signal.SIGINT), (signal.SIGTERM, signal.SIGTERM), (signal.SIGHUP, signal.SIGTERM)],
)
def test_a_signal_reaches_the_whole_group_once(tmp_path: Path, sent: signal.Signals, passed_on: signal.Signals) -> None:
    def interrupt() -> None:
        while not (tmp_path / "ready").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), sent)

    before = signal.getsignal(sent)
    thread = threading.Thread(target=interrupt)
    thread.start()
    # The command ends with 0, and yet what follows it must not start.
    assert run_in_group([sys.executable, "-c", CHILD, str(tmp_path)]) == 128 + passed_on
    thread.join()
    assert (tmp_path / "signals").read_text().split() == [str(int(passed_on))]
    assert signal.getsignal(sent) is before
    assert _ends(int((tmp_path / "grandchild").read_text()))


def _ends(pid: int) -> bool:
    """Whether a process ends, or has ended and waits for its parent."""
    for _ in range(1000):
        state = subprocess.run(
            ["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False
        ).stdout
        if not state.strip() or state.startswith("Z"):
            return True
        time.sleep(0.01)
    return False


def test_the_command_gets_no_input() -> None:
    assert run_in_group([sys.executable, "-c", "import sys; raise SystemExit(sys.stdin.read() != '')"]) == 0
