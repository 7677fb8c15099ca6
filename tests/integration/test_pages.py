"""The commands of ``sundae`` in README and docs run as they stand there, page by page."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sundae_ns.cli import main

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = {
    "run PHOTOS": "trains 30,000 steps after COLMAP; test_run.py runs it with fewer, and poses from elsewhere",
    "train CAPTURE": "becomes ns-train, in place of this process; cli/test_train.py reads its command",
    "bench quality": "trains a dozen runs; test_bench_quality.py runs it with two short ones",
    "bench pape": "needs the archives of the paper's captures; cli/test_bench_quality.py reads its plan",
    "view scene.sundae": "serves until Ctrl-C; cli/test_view.py serves a page, and opens and ends it",
    "report DIR/jobs/": "its runs are those of sundae bench quality; test_report.py reports on several runs",
}
"""Commands that do not run here, by how they start, with the reason and the test that covers them."""
NAMES = {"$RUN": "RUN", "capture": "CAPTURE", "RUN_OR_PACK_OR_PLY": "other.ply", "...": ""}
SHORTER = {"--finetune": "2", "--view": "2", "--width": "32", "--height": "24", "--train-views": "6"}
"""Values that suit a small run and a small scene."""


def lines_of(page: Path) -> list[str]:
    return [line.strip() for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("    sundae ")]


def elsewhere(line: str) -> list[str]:
    """Entries of ``ELSEWHERE`` that a command belongs to."""
    return [start for start in ELSEWHERE if line.removeprefix("sundae ").startswith(start)]


def commands_of(page: Path) -> Iterator[list[str]]:
    for line in lines_of(page):
        if not elsewhere(line):
            words = [NAMES.get(word, word) for word in shlex.split(line, comments=True)]
            for option, value in SHORTER.items():
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
    commands = list(commands_of(page))
    if not any(words[1] == "pack" and "scene.sundae" in words for words in commands):  # then another page has made it
        run("pack", "RUN", "-o", "scene.sundae")
    for words in commands:
        run(*words[1:])


def test_nothing_is_left_out_without_need() -> None:
    left_out = [start for page in PAGES for line in lines_of(page) for start in elsewhere(line)]
    assert set(left_out) == set(ELSEWHERE)


def test_the_readme_has_commands_to_run() -> None:
    found = {words[1] for words in commands_of(PAGES[0])}
    assert {"doctor", "pack", "unpack", "export", "prune", "report", "bench"} <= found
