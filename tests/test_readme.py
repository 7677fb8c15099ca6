"""README and docs: links resolve, and commands, their options, and functions of equations exist."""

import pkgutil
import re
import shlex
from pathlib import Path

import pytest

from sundae_ns.cli import main

ROOT = Path(__file__).parents[1]
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def commands_of(program):
    """Commands of a program in indented blocks and in backticks of all pages, as words without comments."""
    for path in TEXTS:
        text = path.read_text(encoding="utf-8")
        blocks = "\n".join(line.strip() for line in text.splitlines() if line.startswith("    "))
        for line in [*blocks.replace("\\\n", " ").splitlines(), *re.findall(r"`([^`\n]+)`", text)]:
            if line.startswith(f"{program} ") and line.count("'") % 2 == 0 and line.count('"') % 2 == 0:
                yield shlex.split(line, comments=True)


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_links_resolve(path):
    for target in LINK.findall(path.read_text(encoding="utf-8")):
        name, _, anchor = target.partition("#")
        if "://" in name:
            continue
        there = (path.parent / name).resolve() if name else path
        assert there.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", there.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in headings}, target


def test_commands_of_sundae_exist(capsys):
    helps = {}
    for _, command, *words in (words for words in commands_of("sundae") if len(words) > 1 and words[1][:1] != "-"):
        if command not in helps:
            with pytest.raises(SystemExit) as caught:
                main([command, "--help"])
            assert caught.value.code == 0, command
            helps[command] = capsys.readouterr().out
        options = [word.partition("=")[0] for word in words if re.fullmatch(r"--?[a-z][\w.-]*(=.*)?", word)]
        assert [option for option in options if not re.search(rf"{option}\b", helps[command])] == [], (command, *words)
    assert len(helps) > 5


def test_scripts_and_targets_exist():
    for words in commands_of("python"):
        assert not words[1].endswith(".py") or (ROOT / words[1]).is_file(), words
    makefile = (ROOT / "Makefile").read_text()
    targets = {words[1] for words in commands_of("make")}
    assert {"demo", "test"} <= targets
    assert [target for target in targets if not re.search(rf"^{target}:", makefile, re.MULTILINE)] == []


def test_named_tests_exist_and_every_results_file_is_named():
    text = "".join(path.read_text(encoding="utf-8") for path in TEXTS)
    assert set(re.findall(r"`(test_\w+)", text)) <= {path.stem for path in (ROOT / "tests").rglob("test_*.py")}
    scripts = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "benchmarks").glob("*.py"))
    results = ROOT / "benchmarks" / "results"
    assert [path.name for path in results.iterdir() if path.name not in text + scripts] == []


METHOD = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
NAME = re.compile(r"`(sundae_ns(?:\.\w+)+)`")


@pytest.mark.parametrize("name", sorted(set(NAME.findall(METHOD))))
def test_every_function_of_the_method_exists(name):
    assert callable(pkgutil.resolve_name(name))
