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

from sundae_ns.cli.process import quoted, run_in_group, word
from sundae_ns.errors import StorageError
from sundae_ns.storage.run_folder import reserve

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


TREE = """
import pathlib, subprocess, sys, time
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
pathlib.Path(sys.argv[1], "ready").touch()
time.sleep(600)
"""
INTERRUPTED = """
import sys
from sundae_ns.cli.process import run_in_group
sys.exit(run_in_group([sys.executable, "-c", sys.argv[1], sys.argv[2]], saves=sys.argv[3] == "saves"))
"""


@pytest.mark.parametrize(("saves", "lines"), [("saves", True), ("ends", False)])
def test_an_interrupt_prints_nothing_where_nothing_is_saved(tmp_path: Path, saves: str, lines: bool) -> None:
    words = [sys.executable, "-c", INTERRUPTED, TREE, str(tmp_path), saves]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        while not (tmp_path / "ready").exists():
            time.sleep(0.01)
        time.sleep(0.3)  # the grandchild starts
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert ("Traceback" in said) == lines
    assert bool(said) == lines


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


PARENT = """
import sys
from pathlib import Path
from sundae_ns.cli.process import run_in_group, run_logged
from sundae_ns.storage.run_folder import reserve
words, here = [sys.executable, "-c", sys.argv[1], sys.argv[2]], Path(sys.argv[2])
if sys.argv[3] == "in a group":
    run_in_group(words, locks=[reserve(here)])
else:
    run_logged(words, here / "log")
"""
STUBBORN = """
import pathlib, signal, subprocess, sys, time
here = pathlib.Path(sys.argv[1])
code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(600)"
grandchild = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
grandchild.stdout.readline()
(here / "grandchild").write_text(str(grandchild.pid))

def save(number, frame):
    (here / "saving").touch()
    while not (here / "saved").exists():
        time.sleep(0.01)
    sys.exit(0)

signal.signal(signal.SIGTERM, save)
(here / "ready").touch()
while True:
    time.sleep(600)
"""


@pytest.mark.parametrize("way", ["in a group", "logged"])
def test_a_killed_process_leaves_no_command_behind(tmp_path: Path, way: str) -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT, STUBBORN, tmp_path, way])
    _wait_for(tmp_path / "ready")
    parent.kill()
    parent.wait()
    _wait_for(tmp_path / "saving")  # the command may end by itself
    if way == "in a group":
        with pytest.raises(StorageError, match=f"process {parent.pid} on .* trains in"):
            reserve(tmp_path)
    (tmp_path / "saved").touch()
    assert _ends(int((tmp_path / "grandchild").read_text()))
    for _ in range(1000):  # the guard ends with the grandchild, a moment before or after it
        try:
            reserve(tmp_path)
            break
        except StorageError:
            time.sleep(0.01)
    reserve(tmp_path)


def _wait_for(path: Path) -> None:
    for _ in range(3000):
        if path.exists():
            return
        time.sleep(0.01)
    pytest.fail(f"there is no {path.name}")


def test_a_command_that_is_not_installed(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_in_group(["no-such-command-of-sundae"]) == 127
    assert capfd.readouterr().err == "sundae: no-such-command-of-sundae cannot be started (No such file or directory)\n"


def test_a_path_is_no_option() -> None:
    assert [word(Path(name)) for name in ("-a", "--help", "a", "/-a")] == ["./-a", "./--help", "a", "/-a"]
    assert [quoted(Path(name)) for name in ("-a", "a b", "$(b)")] == ["./-a", "'a b'", "'$(b)'"]
