"""Starts the ranks that run the checks of a file, and reads their results."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from forked import run
from models import *  # noqa: F403

RANKS = 2
LIMIT = 600
"""Seconds that a program may take on a busy machine."""


def _run_ranks(file: str, folder: Path) -> None:
    # A missing result fails by name.
    print(run(Path(__file__).with_name("rank.py"), file, RANKS, folder, LIMIT)[1])


def _passed(folder: Path, name: str) -> None:
    for rank in range(RANKS):
        path = folder / f"rank{rank}.json"
        assert path.exists(), f"rank {rank} did not come to an end"
        results = json.loads(path.read_text())
        assert results.get(name, "not reached") == "", f"rank {rank}: {results.get(name)}"


@pytest.fixture(scope="session")
def run_ranks() -> Callable[[str, Path], None]:
    """Run the checks of a file on two ranks, which write their results into a folder."""
    return _run_ranks


@pytest.fixture(scope="session")
def passed() -> Callable[[Path, str], None]:
    """Assert that every rank has passed a check."""
    return _passed
