"""Starts the ranks that go through a file's checks, and reads what they said."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

RANKS = 2
LIMIT = 600
"""Seconds that a program may take on a busy machine."""


def _run_ranks(file: str, folder: Path) -> None:
    rank = [sys.executable, str(Path(__file__).with_name("rank.py")), file]
    programs = [subprocess.Popen([*rank, str(i), str(RANKS), str(folder)]) for i in range(RANKS)]
    try:
        for program in programs:
            program.wait(LIMIT)
    except subprocess.TimeoutExpired:
        pass  # what is missing then fails by name
    finally:
        for program in programs:
            program.kill()
            program.wait()


def _passed(folder: Path, name: str) -> None:
    for rank in range(RANKS):
        path = folder / f"rank{rank}.json"
        assert path.exists(), f"rank {rank} did not come to an end"
        said = json.loads(path.read_text())
        assert said.get(name, "not reached") == "", f"rank {rank}: {said.get(name)}"


@pytest.fixture(scope="session")
def run_ranks() -> Callable[[str, Path], None]:
    """Two ranks go through the checks of a file, and leave what they said in a folder."""
    return _run_ranks


@pytest.fixture(scope="session")
def passed() -> Callable[[Path, str], None]:
    """Asserts that every rank has come through a check."""
    return _passed
