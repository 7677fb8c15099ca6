"""The ``sundae`` command itself, and ``sundae demo``: errors as one line; integration/ trains."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import refusal, run

from sundae_ns.cli import main
from sundae_ns.cli.demo import demo
from sundae_ns.core.errors import SundaeError


@pytest.mark.parametrize("wrong", ["foreign folder", "file", "option"])
def test_errors_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: str) -> None:
    out, more = tmp_path / "demo", []
    if wrong == "foreign folder":
        out.mkdir()
        (out / "thesis.txt").write_text("years of work")
    elif wrong == "file":
        out.write_text("years of work")
    else:
        more = ["--steps", "0"]
    refusal(capsys, "demo", out, *more)
    if wrong == "foreign folder":
        assert [path.name for path in out.iterdir()] == ["thesis.txt"]


def test_other_errors_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> int:
        raise ZeroDivisionError

    monkeypatch.setattr("sundae_ns.cli.doctor.parts", broken)
    with pytest.raises(ZeroDivisionError):
        main(["doctor"])


@pytest.mark.parametrize(
    ("words", "remedy"),
    [([], "sundae --help lists them"), (["fly"], "sundae --help lists them"), (["reprot"], "use report")],
)
def test_unknown_commands_are_one_line(words: list[str], remedy: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert refusal(capsys, *words).endswith(remedy)


def test_installed_command_and_its_exit_code(tmp_path: Path) -> None:
    command = Path(sys.executable).parent / "sundae"
    out = tmp_path / "file"
    out.touch()
    result = subprocess.run([command, "demo", out], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("chosen", [None, "ACTIVE"])
def test_threads_of_torch_do_not_spin_unless_the_user_chose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chosen: str | None
) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    if chosen is None:
        monkeypatch.delenv("OMP_WAIT_POLICY")
    run("export", tmp_path / "missing", tmp_path / "out.ply")
    assert os.environ["OMP_WAIT_POLICY"] == (chosen or "PASSIVE")


def test_torch_is_not_loaded_before_a_command_starts() -> None:
    code = "import sys, sundae_ns.cli; sys.exit(bool({'torch', 'numpy', 'nerfstudio'} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(("steps", "message"), [(0, "steps is 0; give at least 1"), (300, "made"), (None, "made")])
def test_a_demo_of_no_step_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int | None, message: str
) -> None:
    def make(scene: Path) -> None:
        scene.mkdir(parents=True)
        raise SundaeError("made")

    monkeypatch.setattr("sundae_ns.cli.demo.write_demo_capture", make)
    with pytest.raises(SundaeError, match=message):
        demo(tmp_path / "demo", steps=steps)
    assert (tmp_path / "demo").exists() == (message == "made")
