"""``sundae train``: the command that it prints is the one that it runs, and ns-train knows its options."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import pytest
import tyro

from sundae_ns import method_configs
from sundae_ns.cli import main
from sundae_ns.cli.train import methods


class Replaced(Exception):
    """In place of the process that would be replaced."""


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    found: list[list[str]] = []

    def replace(program: str, words: list[str]) -> None:
        assert Path(program).name == "ns-train"
        found.append(words)
        raise Replaced

    monkeypatch.setattr(os, "execvp", replace)
    return found


@pytest.mark.parametrize("method", methods())
def test_the_printed_command_runs(
    tmp_path: Path, ran: list[list[str]], capsys: pytest.CaptureFixture[str], method: str
) -> None:
    words = ["train", str(tmp_path), "-o", "my runs", "--method", method, "--steps", "700"]
    with pytest.raises(Replaced):
        main([*words, "--keep", "0.05"])
    (line,) = capsys.readouterr().out.splitlines()
    assert shlex.split(line) == ran[0]
    assert ran[0][:2] == ["ns-train", method]
    usual = getattr(method_configs, method.replace("-", "_")).config
    config = tyro.cli(type(usual), default=usual, args=ran[0][2:])
    assert (config.data, config.output_dir, config.max_num_iterations) == (tmp_path, Path("my runs"), 700)
    assert config.pipeline.model.pruning.keep_ratio == 0.05


def test_what_is_not_given_is_the_method_s_own(tmp_path: Path, ran: list[list[str]]) -> None:
    with pytest.raises(Replaced):
        main(["train", str(tmp_path)])
    assert ran == [["ns-train", "sundae", "--data", str(tmp_path), "--output-dir", "outputs"]]


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        (["--keep", "0"], "keep is 0.0"),
        (["--keep", "1.5"], "keep is 1.5"),
        (["--steps", "0"], "steps is 0"),
        (["--method", "splatfacto"], "splatfacto is no method of sundae; use one of sundae, "),
        (["gone"], "gone does not exist"),
    ],
)
def test_refusals_are_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    ran: list[list[str]],
    options: list[str],
    cause: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        main(["train", *(options if options == ["gone"] else [".", *options])])
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert cause in line
    assert ran == []
