"""Scripts of ``benchmarks/`` say what they do when they are asked, and do it only when they are not."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

from sundae_ns.evaluation import read_rows

FOLDER = Path(__file__).parents[1] / "benchmarks"
DATAPARSER = {"--colmap-path", "--downscale-factor", "--eval-mode", "--eval-interval"}
SCRIPTS = sorted(path.name for path in FOLDER.glob("*.py") if "__main__" in path.read_text(encoding="utf-8"))


def run(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: str) -> int:
    """Run a script as ``python benchmarks/NAME ARGUMENTS`` does, and give its exit code."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with pytest.raises(SystemExit) as caught:
        runpy.run_path(str(FOLDER / name), run_name="__main__")
    assert isinstance(caught.value.code, int)
    return caught.value.code


@pytest.mark.parametrize("name", SCRIPTS)
def test_help(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, name, "--help") == 0
    assert capsys.readouterr().out.startswith(f"usage: {name}")


def test_a_table_of_branches_that_were_not_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "branch_table.py", "3") == 2
    assert "there are no branches of 3 steps; give one of " in capsys.readouterr().err


def test_commands_of_rows_are_ones_that_ns_train_takes() -> None:
    """What a row says was run can be typed: options come before the dataparser, and a branch's are named as its script's."""
    rows = [row for row in read_rows(FOLDER / "results" / "runs.csv") if row.command.startswith("ns-train ")]
    assert len(rows) > 500
    for row in rows:
        _, _, of_parser = row.command.partition(" colmap ")
        options, _, of_script = of_parser.partition(" (")
        assert "--pipeline." not in options, row
        assert set(re.findall(r"--\S+", options)) <= DATAPARSER, row
        assert not of_script or of_script.startswith(("branch.py --", "mcmc.py --")), row


def test_the_command_of_a_rules_row_is_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = read_rows(FOLDER / "results" / "runs.csv")
    row = [row for row in rows if (row.variant, row.keep_ratio) == ("paper", 0.3)][-1]
    config = tyro.cli(AnnotatedBaseConfigUnion, args=row.command.split()[1:])
    pruning = config.pipeline.model.pruning  # type: ignore[attr-defined]
    assert (config.max_num_iterations, pruning.keep_ratio) == (row.steps, 0.3)
    assert (pruning.selection, pruning.score, pruning.signal) == ("band", "response", "positions")
