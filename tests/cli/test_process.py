"""Commands in a process group: exit codes, and signals that reach them and what they started."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from run_commands import NASTY

from sundae_ns.cli.options import word
from sundae_ns.cli.process import run_command, run_logged
from sundae_ns.core.errors import SundaeError

CHILD = """
import pathlib, signal, subprocess, sys
here = pathlib.Path(sys.argv[1])
grandchild = subprocess.Popen(["sleep", "600"])  # no Python, which loses a SIGINT while it starts
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


def test_the_exit_code_is_the_command_s_and_no_word_reaches_a_shell(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    codes = {"raise SystemExit(7)": 7, "import os; os.kill(os.getpid(), 9)": 137}
    for code, expected in {**codes, f"import sys; raise SystemExit(sys.argv[1] != {NASTY!r})": 0}.items():
        assert run_command([sys.executable, "-c", code, NASTY]) == expected
    assert not list(tmp_path.iterdir())


def test_the_command_gets_no_input():
    before = os.dup(0)
    with open(__file__) as typed:
        os.dup2(typed.fileno(), 0)
    try:
        assert run_command([sys.executable, "-c", "import sys; raise SystemExit(sys.stdin.read() != '')"]) == 0
    finally:
        os.dup2(before, 0)
        os.close(before)


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_reaches_the_whole_group_once(tmp_path, sent):
    passed_on = signal.SIGTERM if sent == signal.SIGHUP else sent

    def interrupt():
        wait_until((tmp_path / "ready").exists)
        os.kill(os.getpid(), sent)

    # Suites in the background inherit signals that are ignored.
    before = signal.default_int_handler
    inherited = signal.signal(sent, before)
    thread = threading.Thread(target=interrupt)
    thread.start()
    # The command ends with 0, and yet what follows it must not start.
    assert run_command([sys.executable, "-c", CHILD, str(tmp_path)]) == 128 + passed_on
    thread.join()
    assert (tmp_path / "signals").read_text().split() == [str(int(passed_on))]
    assert signal.getsignal(sent) is before
    signal.signal(sent, inherited)
    status = Path("/proc", (tmp_path / "grandchild").read_text(), "stat")
    wait_until(lambda: not status.exists() or ") Z " in status.read_text())  # it ends, or waits for its parent


def wait_until(condition):
    for _ in range(3000):
        if condition():
            return
        time.sleep(0.01)
    pytest.fail("it never happens")


PARENT = """
import sys
from pathlib import Path
from sundae_ns.cli.process import run_command, run_logged
words, here = [sys.executable, "-c", sys.argv[1], sys.argv[2]], Path(sys.argv[2])
run_command(words) if sys.argv[3] == "shown" else run_logged(words, here / "log")
"""


@pytest.mark.parametrize("way", ["shown", "logged"])
def test_a_command_ends_with_a_killed_process(tmp_path, way):
    parent = subprocess.Popen([sys.executable, "-c", PARENT, CHILD, tmp_path, way], stdout=subprocess.DEVNULL)
    wait_until((tmp_path / "ready").exists)
    parent.kill()
    parent.wait()
    wait_until((tmp_path / "signals").exists)
    assert (tmp_path / "signals").read_text().split() == [str(int(signal.SIGTERM))], "a training saves itself"


def test_a_command_that_is_not_installed():
    with pytest.raises(SundaeError, match="^no-such-command cannot be started \\(No such file or directory\\); "):
        run_command(["no-such-command"])


TRAINING = """
import sys
print("[00:00:01] Caching images                    full_images_datamanager.py:230")
print("           Dataset is overriding indices")
print("60 steps")
print("┏━━━┓\\n┃ part ┃\\n┡━━━┩\\n│ images │ full size │\\n└───┘")
print("╭─ viser ─╮\\n│   HTTP  │ http://0.0.0.0:7007 │\\n╰─╯")
print("[00:00:02] step 30: kept 1,245 of 4,980 Gaussians", flush=True)
print("UserWarning: lr_scheduler", file=sys.stderr, flush=True)
print("Warning: LPIPS is left out", flush=True)
print("30 (50.00%)  9 s left at 171 ms a step  PSNR 15.35 dB  1,245 Gaussians", flush=True)
print(*sys.argv[1:2], file=sys.stderr)
sys.exit(len(sys.argv) > 1)
"""


def test_a_logged_training_shows_messages_and_the_schedule(tmp_path, capfd):
    log = tmp_path / "train.log"
    assert run_command([sys.executable, "-c", TRAINING], log) == 0
    _, *printed = capfd.readouterr().out.split(TRAINING)[-1].splitlines()
    shown = ["60", "┏━━━┓", "┃", "┡━━━┩", "│", "└───┘", "[00:00:02]", "Warning:", "30"]
    assert [line.split()[0] for line in printed] == shown
    assert "full_images_datamanager" in log.read_text(encoding="utf-8")
    assert "lr_scheduler" in log.read_text(encoding="utf-8")


@pytest.mark.parametrize(("cause", "shown"), [("sundae: a is damaged; repair it", False), ("KeyError: 'a'", True)])
def test_a_logged_training_that_fails_says_why(tmp_path, capfd, cause, shown):
    assert run_command([sys.executable, "-c", TRAINING, cause], tmp_path / "log") == 1
    printed = capfd.readouterr()
    assert cause in (printed.err if shown else printed.out)
    assert bool(printed.err) == shown


def test_an_error_leaves_no_logged_command_behind(tmp_path):
    pids = []

    def interrupt(line):
        pids.append(int(line))
        raise KeyboardInterrupt

    code = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    with pytest.raises(KeyboardInterrupt):
        run_logged([sys.executable, "-c", code], tmp_path / "log.txt", interrupt)
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)


def test_a_signal_that_is_ignored_stays_ignored():
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        code = "import os, signal; os.kill(os.getppid(), signal.SIGHUP); os.kill(os.getpid(), signal.SIGHUP)"
        assert run_command([sys.executable, "-c", code]) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_path_is_no_option():
    assert [word(Path(name)) for name in ("-a", "--help", "a", "/-a")] == ["./-a", "./--help", "a", "/-a"]
