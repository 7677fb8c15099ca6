"""The ``sundae`` command itself: help, exit codes, names that are no text, warnings of libraries."""

import getpass
import io
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from command_line import refusal, run

import sundae_ns as sn
from sundae_ns.cli import main

SUNDAE = Path(sys.executable).parent / "sundae"


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ([], 2, "show a scene with its head in the browser"),
        (["--help"], 0, "sundae COMMAND --help shows"),
        (["help", "view"], 0, "usage: sundae view "),
        (["help", "export"], 0, " Below the full scene are "),
        (["--version"], 0, f"sundae_ns {sn.__version__}\n"),
    ],
)
def test_what_a_newcomer_types(words, code, says, capsys):
    assert run(*words) == code
    printed = capsys.readouterr()
    assert says in printed.out
    assert not printed.err


def test_no_folder_for_temporary_files(monkeypatch, capsys):
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", list)
    assert "no folder for temporary files can be written; make room" in refusal(capsys, "info", "a.ply")
    monkeypatch.setattr("os.getcwd", Mock(side_effect=FileNotFoundError))
    assert "the working folder is gone; cd to another" in refusal(capsys, "info", "a.ply")


def test_other_errors_are_not_hidden(monkeypatch):
    monkeypatch.setattr("sundae_ns.cli.doctor.parts", Mock(side_effect=ZeroDivisionError))
    with pytest.raises(ZeroDivisionError):
        main(["doctor"])


def test_a_user_without_an_account_has_a_name(monkeypatch):
    monkeypatch.setattr("os.environ", {})
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as without a home
    run("--version")
    assert (os.environ["HOME"], getpass.getuser()) == ("/", str(os.getuid()))  # torch asks for it, in a container too


@pytest.mark.parametrize("chosen", [None, "ACTIVE"])
def test_threads_of_torch_do_not_spin_unless_the_user_chose(tmp_path, monkeypatch, chosen):
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    if chosen is None:
        monkeypatch.delenv("OMP_WAIT_POLICY")
    run("export", tmp_path / "missing", tmp_path / "out.ply")
    assert os.environ["OMP_WAIT_POLICY"] == (chosen or "PASSIVE")


def test_torch_is_not_loaded_before_a_command_starts():
    code = "import sys, sundae_ns.cli; sys.exit(bool({'torch', 'numpy', 'nerfstudio'} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_installed_command_takes_any_name_and_no_warning_for_an_error(tmp_path):
    """Names of files may hold bytes that are no text."""
    environment = {**os.environ, "PYTHONWARNINGS": "error", "PYTHONUTF8": "1", "PYTHONOPTIMIZE": "2"}  # no docstrings
    done = subprocess.run([SUNDAE, "train", b"\n\xff"], cwd=tmp_path, env=environment, capture_output=True, check=False)
    assert done.stderr == b"sundae: \\n\\udcff does not exist; check the path\n"
    assert (done.returncode, done.stdout) == (2, b"")


def test_a_file_of_any_name_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    sn.save(sn.Scene.from_points(torch.rand(50, 3), torch.rand(50, 3)), tmp_path / "a.glb")
    name = os.fsdecode(b"\xff.html")
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), "utf-8", errors="backslashreplace"))
    assert run("export", "~/a.glb", f"--out=~/{name}") == 0
    assert sys.stdout.buffer.getvalue().startswith(os.fsencode(tmp_path) + b"/\\udcff.html: ")
    assert Path(name).stat().st_size > 1000
