"""README and docs: few pages of short lines, whose links, figures, commands, options and tables are right."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from sundae_ns.cli import main
from sundae_ns.compensation import HeadConfig
from sundae_ns.method_configs.sundae import sundae
from sundae_ns.training.pruning import PruningConfig

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"`([^`\n]+)`")
HASH = re.compile(r"(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,40}")
DOCS_PAGE = re.compile(r"docs/\w+\.md")
PARSERS = ("colmap", "nerfstudio-data")
ELSEWHERE = {"data", "help"}
"""Options of ``ns-train`` that are not in the configuration: one that nerfstudio spells shorter, and tyro's own."""


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def long_lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if len(line) > 120]


def hashes(text: str) -> list[str]:
    """Commit hashes among the words in backticks; a number or a word of plain letters is none."""
    return [word for code in CODE.findall(text) for word in code.split() if HASH.fullmatch(word)]


def anchors(text: str) -> set[str]:
    """Anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(text: str, folder: Path) -> list[str]:
    """Relative links to files or headings that do not exist."""
    broken = []
    for target in LINK.findall(text):
        path, _, anchor = target.partition("#")
        if "://" in path:
            continue
        there = (folder / path).resolve() if path else None
        lost_anchor = anchor and anchor not in anchors(text if there is None else text_of(there))
        if (there is not None and not there.exists()) or lost_anchor:
            broken.append(target)
    return broken


def commands(text: str) -> Iterator[list[str]]:
    """Commands in indented blocks and in backticks as words, without comments; placeholders stay as they are."""
    blocks = "\n".join(line.strip() for line in text.splitlines() if line.startswith("    "))
    for line in [*blocks.replace("\\\n", " ").splitlines(), *CODE.findall(text)]:
        try:
            yield shlex.split(line, comments=True)
        except ValueError:  # an apostrophe in what is no command
            continue


def commands_of(program: str, *paths: Path) -> list[list[str]]:
    return [words for path in paths for words in commands(text_of(path)) if words[:1] == [program] and len(words) > 1]


def options(words: Sequence[str]) -> list[str]:
    return [word.partition("=")[0] for word in words if re.fullmatch(r"--?[a-z][\w.-]*(=.*)?", word)]


def subcommand(words: Sequence[str]) -> list[str]:
    return list(words[1:3] if words[1:2] == ["bench"] else words[1:2])


def configured(path: str, config: Any = sundae.config) -> bool:
    """Whether an option as ``pipeline.model.head.start-at`` is a place in a configuration."""
    for part in path.replace("-", "_").split("."):
        if isinstance(config, dict) and part in config:
            config = config[part]
        elif hasattr(config, part):
            config = getattr(config, part)
        else:
            return False
    return True


def misses_of_training(words: Sequence[str]) -> list[str]:
    """Options of an ``ns-train`` command that sundae's configuration lacks; those behind a data parser are not read."""
    ends = [i for i, word in enumerate(words) if word in PARSERS] or [len(words)]
    names = [option.lstrip("-") for option in options(words[: ends[0]])]
    return [option for option in names if option not in ELSEWHERE and not configured(option)]


def test_pages_are_few_and_short() -> None:
    assert len(PAGES) <= 11
    assert sum(len(text_of(page).splitlines()) for page in PAGES) < 1900
    assert len(text_of(ROOT / "README.md").splitlines()) <= 110


def test_decisions_are_numbered_in_order() -> None:
    found = re.findall(r"^### (\d+)\. .*\(\d{4}-\d\d-\d\d\)$", text_of(ROOT / "docs" / "decisions.md"), re.MULTILINE)
    assert list(map(int, found)) == list(range(1, len(found) + 1))
    assert len(found) > 20


@pytest.mark.parametrize("path", TEXTS, ids=name)
def test_lines_are_short_and_name_no_commit(path: Path) -> None:
    assert long_lines(text_of(path)) == []
    assert hashes(text_of(path)) == []


@pytest.mark.parametrize("path", TEXTS, ids=name)
def test_links_resolve(path: Path) -> None:
    assert broken_links(text_of(path), path.parent) == []


def test_every_page_is_reached_from_the_readme_and_every_figure_is_shown() -> None:
    linked = {
        (page.parent / target.partition("#")[0]).resolve() for page in PAGES for target in LINK.findall(text_of(page))
    }
    from_readme = {(ROOT / target).resolve() for target in LINK.findall(text_of(ROOT / "README.md"))}
    assert set(PAGES[1:]) <= from_readme
    assert {path for path in (ROOT / "docs" / "figures").iterdir() if path not in linked} == set()


def test_pages_that_code_names_exist() -> None:
    for folder in ("sundae_ns", "method_configs", "tests", "benchmarks"):
        for path in (ROOT / folder).rglob("*.py"):
            missing = [page for page in DOCS_PAGE.findall(text_of(path)) if not (ROOT / page).exists()]
            assert missing == [], name(path)


def test_commands_of_sundae_exist(capsys: pytest.CaptureFixture[str]) -> None:
    found = commands_of("sundae", *TEXTS)
    assert len(found) > 40
    helps = {}
    for words in found:
        command = subcommand(words)
        if words[1].startswith("-"):
            continue
        key = " ".join(command)
        if key not in helps:
            with pytest.raises(SystemExit) as caught:
                main([*command, "--help"])
            assert caught.value.code == 0, key
            helps[key] = capsys.readouterr().out
        assert [option for option in options(words) if not re.search(rf"{option}\b", helps[key])] == [], words


def test_commands_of_training_exist() -> None:
    methods = re.findall(r'^(sundae[\w-]*) = "sundae_ns.method_configs', text_of(ROOT / "pyproject.toml"), re.MULTILINE)
    found = commands_of("ns-train", *TEXTS)
    assert len(found) > 10
    for words in found:
        if words[1].startswith("-"):
            continue
        assert words[1] in methods, words
        assert misses_of_training(words) == []


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_options_in_backticks_exist(path: Path) -> None:
    # CHANGELOG.md names options that are gone.
    for code in CODE.findall(text_of(path)):
        for prefix, config in (("pruning.", PruningConfig()), ("head.", HeadConfig())):
            if re.fullmatch(rf"{re.escape(prefix)}[a-z][a-z-]+( .*)?", code):
                assert configured(code.split()[0].removeprefix(prefix), config), code
        if re.match(r"--pipeline\.\S*\w( |$)", code):
            assert configured(code.split()[0].lstrip("-")), code


def test_scripts_and_targets_exist() -> None:
    scripts = {word for words in commands_of("python", *TEXTS) for word in words[1:2] if word.endswith(".py")}
    assert len(scripts) > 5
    assert {script for script in scripts if not (ROOT / script).is_file()} == set()
    targets = {words[1] for words in commands_of("make", *TEXTS)}
    assert {"demo", "test"} <= targets
    assert {
        target for target in targets if not re.search(rf"^{target}:", text_of(ROOT / "Makefile"), re.MULTILINE)
    } == set()


def test_the_checks_can_fail(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A page\n\n[here](#a-page) [there](other.md) [web](https://example.org)\n")
    assert broken_links(text_of(page), tmp_path) == ["other.md"]
    assert broken_links("# One\n[two](#two)\n", tmp_path) == ["#two"]
    assert hashes("at `0a1b2c3`, `2026111`, `deadbeef`, `features`") == ["0a1b2c3"]
    assert long_lines("x" * 121) == ["x" * 121]
    assert list(commands("    make demo  # a comment\n    a \\\n      b\nand `sundae pack RUN`\n")) == [
        ["make", "demo"],
        ["a", "b"],
        ["sundae", "pack", "RUN"],
    ]
    assert misses_of_training(shlex.split("ns-train sundae --data D --no-such.option 1 colmap --eval-mode x")) == [
        "no-such.option"
    ]
    assert not configured("rounds-of-pruning", PruningConfig())
