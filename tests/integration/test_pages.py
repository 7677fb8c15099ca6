"""The commands of ``sundae`` in README and docs run as they stand there, page by page."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sundae_ns.cli import main

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = re.compile(r"sundae (demo|scene|doctor|train|bench (quality|paper)|[^#]*\*)")
"""Commands that train, take minutes, compile, or need other folders; tests of their own run them."""
NAMES = {"$RUN": "RUN", "capture": "CAPTURE", "RUN_OR_PACK_OR_PLY": "other.ply", "...": ""}
SHORTER = [("--finetune", "2"), ("--view", "2")]
"""Values that suit a small run."""


def commands_of(page: Path) -> Iterator[list[str]]:
    for line in page.read_text(encoding="utf-8").splitlines():
        if line.startswith("    sundae ") and not ELSEWHERE.match(line.strip()):
            words = [NAMES.get(word, word) for word in shlex.split(line, comments=True)]
            for option, value in SHORTER:
                if option in words:
                    words[words.index(option) + 1] = value
            yield [word for word in words if word]


@pytest.mark.parametrize("page", [page for page in PAGES if list(commands_of(page))], ids=lambda page: page.name)
def test_commands_run_as_they_stand(page: Path, tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(tiny.folder, "RUN")
    shutil.copytree(tiny.scene, "CAPTURE")

    def run(*words: str) -> None:
        with pytest.raises(SystemExit) as caught:
            main(words)
        assert caught.value.code == 0, words

    run("export", "RUN", "-o", "other.ply")
    for words in commands_of(page):
        run(*words[1:])


def test_the_readme_has_commands_to_run() -> None:
    found = {words[1] for words in commands_of(PAGES[0])}
    assert {"pack", "unpack", "export", "prune", "report", "bench"} <= found
