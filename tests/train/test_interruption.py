"""Signals while training, and the command that resumes."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sundae_ns.train.progress import Interruption, resume_command


def test_the_first_signal_is_noted_and_the_handlers_come_back() -> None:
    before, asked = signal.getsignal(signal.SIGTERM), []
    with Interruption(lambda: asked.append(True), quiet=True) as interruption:
        assert interruption.number == 0
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)  # of a scheduler that asks again
        assert (interruption.number, asked) == (signal.SIGTERM, [True])
    assert signal.getsignal(signal.SIGTERM) is before


TWICE = """
import signal
from sundae_ns.train.progress import Interruption
with Interruption(lambda: None):
    signal.raise_signal(signal.SIGINT)
    print("saving", flush=True)
    signal.raise_signal(signal.SIGINT)
    print("too late")
"""


def test_a_second_one_leaves_at_once() -> None:
    result = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (130, "saving\n")
    assert "Left without saving" in result.stderr


@pytest.mark.parametrize(
    ("started", "expected"),
    [
        ("sundae --data a --max-num-iterations 9", "sundae --load-dir run --data a"),
        ("sundae --max-num-iterations=9 --vis viewer", "sundae --load-dir run --vis viewer"),
        (
            "sundae-1 --load-dir old --load-step 4 --data a colmap --colmap-path s",
            "sundae-1 --load-dir run --data a colmap --colmap-path s",
        ),
    ],
)
def test_the_command_that_resumes(started: str, expected: str) -> None:
    program = ["/usr/bin/ns-train", *started.split()]
    assert resume_command(program, Path("run"), "sundae", "data") == f"ns-train {expected}"


def test_the_command_that_resumes_what_another_program_started() -> None:
    found = resume_command(["pytest", "--load-dir", "x"], Path("a run"), "sundae-1", Path("data"))
    assert found == "ns-train sundae-1 --data data --load-dir 'a run'"
