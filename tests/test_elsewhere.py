"""What Windows and macOS need, as far as Linux can tell: no POSIX-only imports, stated encodings, other locks."""

from __future__ import annotations

import ast
import errno
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sundae_ns.cli import process
from sundae_ns.errors import SundaeError
from sundae_ns.storage import atomic, run_folder

fcntl = pytest.importorskip("fcntl", reason="tests what Linux can tell of Windows")
ROOT = Path(__file__).parents[1]
SOURCES = [*(ROOT / "sundae_ns").rglob("*.py"), *(ROOT / "method_configs").rglob("*.py")]

# ----------------------------------------------------------------------------------------------------------- importing

POSIX_MODULES = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")
IMPORTER = """
import importlib, os, pkgutil, signal, sys, sundae_ns

def load():
    for info in pkgutil.walk_packages(sundae_ns.__path__, "sundae_ns."):
        importlib.import_module(info.name)

load()  # libraries of others import what they need of this system
for name in [name for name in sys.modules if name.startswith("sundae_ns.")]:
    del sys.modules[name]
for name in sys.argv[1].split():
    sys.modules[name] = None
for name in ("killpg", "getpgid", "setsid", "fork", "getuid", "geteuid", "sched_getaffinity", "statvfs", "sysconf"):
    delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "SIGALRM", "SIGUSR1", "SIGXFSZ", "alarm", "pause", "setitimer"):
    delattr(signal, name)
for name in [name for name in vars(os) if name in ("O_NOFOLLOW", "O_DIRECTORY", "O_NONBLOCK", "O_SYNC")]:
    delattr(os, name)
sys.platform = "win32"
load()
print(sum(name.startswith("sundae_ns.") for name in sys.modules))
"""


def test_every_module_is_imported_without_what_only_posix_has() -> None:
    words = [sys.executable, "-c", IMPORTER, " ".join(POSIX_MODULES)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) > 100


# ----------------------------------------------------------------------------------------------------------- encodings

NO_TEXT = {"Image", "av", "module.Database", "os", "pycolmap().Database", "webbrowser", "zipfile", "tarfile"}
"""Whose ``open`` opens no text."""


def without_encoding(source: str) -> Iterator[str]:
    """Calls that read or write text in the encoding of the system, which differs on Windows."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        owner = ast.unparse(node.func.value) if isinstance(node.func, ast.Attribute) else None
        name = node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)
        words = {word.arg: ast.unparse(word.value) for word in node.keywords}
        at = 1 if owner is None else 0
        mode = ast.unparse(node.args[at]) if len(node.args) > at else words.get("mode", "'r'")
        opens = name == "open" and owner not in NO_TEXT and "b" not in mode
        moves = owner is not None and name in ("read_text", "write_text")
        pipes = words.get("text", words.get("universal_newlines")) == "True"
        wraps = name in ("TextIOWrapper", "fdopen", "NamedTemporaryFile") and "b" not in mode
        if (opens or moves or pipes or wraps) and "encoding" not in words:
            yield ast.unparse(node)


@pytest.mark.parametrize(
    "source",
    [
        "open(path)",
        "open(path, 'w')",
        "path.open()",
        "path.open(mode='a')",
        "path.read_text()",
        "path.write_text('a')",
        "subprocess.run(words, text=True)",
    ],
)
def test_a_missing_encoding_would_be_noticed(source: str) -> None:
    assert list(without_encoding(source)) == [source]


def test_every_text_has_an_encoding() -> None:
    assert len(SOURCES) > 100
    calls = {str(path.relative_to(ROOT)): list(without_encoding(path.read_text(encoding="utf-8"))) for path in SOURCES}
    assert {name: found for name, found in calls.items() if found} == {}


def test_names_of_new_runs_are_names_on_windows() -> None:
    assert re.fullmatch(r"[\w-]+", run_folder.new_name())


def test_no_file_of_the_repository_has_a_name_that_windows_refuses() -> None:
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, encoding="utf-8", check=False)
    found = [name for name in names.stdout.split("\0") if name]
    if names.returncode != 0 or not found:
        pytest.skip("not a git checkout")
    bad = re.compile(r'[<>:"|?*\\]|[ .](/|$)|(^|/)(con|prn|aux|nul|com\d|lpt\d)(\.|/|$)', re.IGNORECASE)
    assert [name for name in found if bad.search(name)] == []
    assert len({name.lower() for name in found}) == len(found), "names differ in case alone"


# --------------------------------------------------------------------------------------------------------------- locks


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rules of Windows for files and folders."""
    monkeypatch.setattr(atomic, "_WINDOWS", True)


@pytest.mark.usefixtures("windows")
def test_files_are_replaced_without_a_lock_and_a_flushed_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_file(path: Path, flags: int) -> int:
        assert not path.is_dir(), "Windows does not open folders"
        assert flags == os.O_RDWR, "Windows flushes only what it may write"
        return opened(path, flags)

    opened = os.open
    monkeypatch.setattr(os, "open", open_file)
    atomic.write_text(tmp_path / "a.txt", "old\n")
    with atomic.replacing(tmp_path / "a.txt") as partial:
        assert not partial.exists(), "Windows renames no open file"
        partial.write_text("new\n")
    assert (tmp_path / "a.txt").read_bytes() == b"new\n"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_system_without_locks_reserves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object, **__: object) -> bool:
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(atomic, "lock_descriptor", missing)
    run_folder.reserve(tmp_path / "run")


# ----------------------------------------------------------------------------------------------------------- processes


def test_a_command_runs_without_groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "killpg")
    assert process.run_command([sys.executable, "-c", "raise SystemExit(7)"]) == 7
    with pytest.raises(SundaeError, match="failed with 3"):
        process.run_logged([sys.executable, "-c", "raise SystemExit(3)"], tmp_path / "log")
