"""Which revision measured, where there is a checkout, where there is none, and where git fails."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from sundae_ns.scenes import measure


def test_the_revision_is_that_of_the_checkout_or_what_was_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "sundae_ns"
    package.mkdir()
    monkeypatch.setattr(measure, "__file__", str(package / "measure.py"))
    monkeypatch.delenv("BENCHMARK_COMMIT", raising=False)
    assert measure.revision() == "", "an installed package"

    def git(*words: str) -> str:
        identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        command = ["git", "-C", str(tmp_path), *identity, *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    git("init", "--quiet")
    assert measure.revision() == "", "nothing is committed"
    git("commit", "--quiet", "--allow-empty", "--message", "a")
    assert measure.revision() == git("rev-parse", "--short", "HEAD")

    def no_git(*_: Any, **__: Any) -> None:
        raise FileNotFoundError("git")

    monkeypatch.setattr(subprocess, "run", no_git)
    assert measure.revision() == ""
    monkeypatch.setenv("BENCHMARK_COMMIT", "abc1234")
    assert measure.revision() == "abc1234"
