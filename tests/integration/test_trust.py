"""Training that is killed, and faults as a user of the commands sees them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sundae_ns.data import write_scene

ROOT = Path(__file__).parents[2]


def test_killed_anywhere_it_goes_on_as_if_never_killed() -> None:
    """The short version of ``benchmarks/kill_and_resume.py``, which says where the kills fall."""
    result = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "kill_and_resume.py"), "--kills", "3"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    found = json.loads(result.stdout.splitlines()[-1])
    assert found["killed"] == found["same count"] == found["bit for bit the same"] == 3
    assert found["same seed, same result"]
